"""TNTP files: round trips, and errors with their lines."""

import numpy as np
import pytest
from tests.models import traffic_networks as networks

import dvax
from dvax import formats
from dvax.models import traffic

NET, TRIPS = networks.BRAESS_NET, networks.BRAESS_TRIPS
FLOW = """From\tTo\tVolume\tCost
4\t2\t4\t40
1\t4\t2\t52
3\t2\t2\t52
3\t4\t2\t12
1\t3\t4\t40
"""
NODE = """Node\tX\tY\t;
2\t1.0\t0.5\t;
1\t-1.0\t0.5\t;
3\t0\t1e0\t;
4\t0\t0\t;
"""


def put(folder, text, name="some_net.tntp"):
    file = folder / name
    file.write_text(text)
    return file


def flaws(read, *arguments):
    with pytest.raises(dvax.InputError) as caught:
        read(*arguments)
    return caught.value.problems


def write(network):
    """A network in the format, by the shortest decimals that give back the same doubles."""
    lines = [
        f"<NUMBER OF ZONES> {network.zones}", f"<NUMBER OF NODES> {network.nodes}",
        f"<FIRST THRU NODE> {network.first_thru_node}", f"<NUMBER OF LINKS> {len(network)}\t\t",
        "<END OF METADATA>", "", "~ " + " ".join((*networks.COLUMNS, "link_type", ";")),
    ]  # fmt: skip
    for k in range(len(network)):
        cells = [repr(getattr(network, name)[k].item()) for name in networks.COLUMNS]
        lines.append("\t".join((*cells, "1", ";")))
    return "\n".join(lines) + "\n"


def test_tntp_files_round_trip(tmp_path):
    network, trips = networks.grid(5, 6, 9, 50, 2e4, seed=3)
    again = formats.read_network(put(tmp_path, write(network)))
    for name in ("zones", "nodes", "first_thru_node"):
        assert getattr(again, name) == getattr(network, name)
    for name in networks.COLUMNS:
        np.testing.assert_array_equal(getattr(again, name), getattr(network, name))
    assert again.place(0) == "some_net.tntp, line 8"
    blocks = [
        f"<NUMBER OF ZONES> 9\n<TOTAL OD FLOW> {trips.flow.sum()}\n<END OF METADATA>\n~ a note"
    ]
    for origin in range(1, 10):
        blocks.append(f"Origin \t{origin}")
        own = np.flatnonzero(trips.origin == origin)[::-1]  # in any order
        blocks.append("".join(f" {trips.destination[i]} : {trips.flow[i]!r};" for i in own))
        blocks.append(f"{origin} : 0.0;")
    text = "\n".join(blocks).replace("np.float64(", "").replace(")", "")
    table = formats.read_trips(put(tmp_path, text, "some_trips.tntp"))
    for name in ("origin", "destination", "flow"):
        np.testing.assert_array_equal(getattr(table, name), getattr(trips, name))


def test_tntp_columns_are_identified_by_name(tmp_path):
    """Units, blanks and unknown columns are accepted."""
    names = (
        "speed (km/h)|B|Power|Term node |Init node|Free Flow Time (min)|Length|Capacity (veh/h)|;"
    )
    header = "~\t" + names.replace("|", "\t")
    row = "\t50\t0.15\t4\t2\t1\t2.5\t3\t900\t;"
    text = NET[: NET.index("~")].replace("LINKS> 5", "LINKS> 1") + f"{header}\n{row}\n"
    network = formats.read_network(put(tmp_path, text))
    assert network.capacity.tolist() == [900.0] and network.free_flow_time.tolist() == [2.5]
    assert (network.init_node[0], network.term_node[0]) == (1, 2) and network.toll is None


def test_tntp_flows_and_nodes_follow_the_order_of_the_network(tmp_path):
    network = formats.read_network(networks.braess(tmp_path)[0])
    flows = formats.read_flows(put(tmp_path, FLOW), network)
    assert flows.volume.tolist() == [4, 2, 2, 2, 4] and flows.cost.tolist() == [40, 52, 52, 12, 40]
    nodes = formats.read_nodes(put(tmp_path, NODE), network)
    assert nodes.tolist() == [[-1.0, 0.5], [1.0, 0.5], [0.0, 1.0], [0.0, 0.0]]


def test_tntp_real_network_is_read():
    folder = networks.SIOUX_FALLS
    if not folder.is_dir():
        pytest.skip(f"the Sioux Falls files are not at {folder}")
    network = formats.read_network(folder / "SiouxFalls_net.tntp")
    trips = formats.read_trips(folder / "SiouxFalls_trips.tntp")
    flows = formats.read_flows(folder / "SiouxFalls_flow.tntp", network)
    nodes = formats.read_nodes(folder / "SiouxFalls_node.tntp", network)
    assert (len(network), network.nodes, len(trips), trips.flow.sum()) == (76, 24, 528, 360600.0)
    cost = networks.bpr(network, flows.volume, 0.0, 0.0)
    np.testing.assert_allclose(cost, flows.cost, atol=1e-13)
    assert nodes.shape == (24, 2)


OF_NETWORKS = {
    "capacity": ("1\t3\t1\t0", "1\t3\t-2000\t0", "line 8", "capacity -2000", "positive"),
    "zero": ("1\t3\t1\t0", "1\t3\t0\t0", "line 8", "capacity 0", "b = 0"),
    "time": ("0\t50\t0.02", "0\t-50\t0.02", "line 9", "free_flow_time -50", "≥ 0"),
    "node": ("\t3\t4\t1", "\t3\t5\t1", "line 11", "term_node 5", "nodes 1 to 4"),
    "no node": ("\t3\t4\t1", "\t3\tD\t1", "line 11", "'D'", "that of a node"),
    "text": ("\t3\t4\t1", "\t3\t4\tmany", "line 11", "'many'", "finite decimal"),
    "infinite": ("\t3\t4\t1", "\t3\t4\t1e999", "line 11", "'1e999'", "finite decimal"),
    "itself": ("\t3\t4\t1", "\t3\t3\t1", "line 11", "from node 3 to itself", "Remove"),
    "twice": ("\t1\t4\t1", "\t1\t3\t1", "line 9", "from 1 to 3", "line 8 has this one"),
    "short": ("\t1\t4\t1", "\t1\t4", "line 9", "9 cells", "names 10 columns"),
    "column": ("capacity", "capazity", "line 7", "capazity", "Did you mean 'capazity'"),
    "power": ("power", "speeds", "line 7", "'speeds'", "Add the column power"),
    "header": ("~", "# ", "some_net.tntp", "no line that names the columns", "init_node term_node"),
    "links": ("LINKS> 5", "LINKS> 6", "line 4", "6 and 5 rows", "as many links as it states"),
    "zones": ("ZONES> 2", "ZONES> 9", "some_net", "9 zones and 4 nodes", "at most as many"),
    "no zones": ("<NUMBER OF ZONES> 2\n", "", "some_net", "<NUMBER OF ZONES>", "metadata"),
    "misspelt": ("OF ZONES", "OF ZONE", "some_net", "<NUMBER OF ZONES>", "<NUMBER OF ZONE>"),
    "count": ("ZONES> 2", "ZONES> two", "line 1", "'two'", "whole number"),
    "again": ("<FIRST", "<NUMBER OF ZONES> 3\n<FIRST", "line 3", "once more", "line 1 has it"),
    "first": ("NODE> 1", "NODE> 7", "some_net", "first_thru_node = 7", "1 to 4"),
    "open": ("<END OF METADATA>", "", "some_net", "no line <END OF METADATA>", "parts"),
}  # fmt: skip


@pytest.mark.parametrize("case", OF_NETWORKS)
def test_tntp_network_errors_name_their_line(case, tmp_path):
    old, new, place, given, said = OF_NETWORKS[case]
    assert old in NET
    found = flaws(formats.read_network, put(tmp_path, NET.replace(old, new, 1)))
    first = found[0]
    assert place in first.place and "some_net.tntp" in first.place, first
    assert given in first.given and said in f"{first.rule} {first.fix}", first


OF_TRIPS = {
    "negative": ("6.0;", "-6.0;", "line 6", "-6 trips from 1 to 2", "≥ 0"),
    "zone": ("2 :      6.0", "3 :      6.0", "line 6", "destination 3", "zones 1 to 2"),
    "origin": ("Origin 1", "Origin 9", "line 6", "origin 9", "zones 1 to 2"),
    "no origin": ("Origin 1", "", "line 6", "'1 :      0.0'", "below the Origin"),
    "what origin": ("Origin 1", "Origin one", "line 5", "'Origin one'", "Origin and a zone"),
    "twice": ("1 :      0.0", "2 :      0.0", "line 6", "from 1 to 2 once more", "Add the two up"),
    "block": ("Origin 1", "Origin 1\n 1 : 0.0;\nOrigin 1", "line 7", "Origin 1 once more", "line 5"),
    "text": ("6.0;", "six;", "line 6", "'2 :      six'", "destination : trips"),
    "no semicolon": ("0.0;", "0.0", "line 6", "'1 :      0.0     2 :      6.0'", "semicolon"),
    "total": ("FLOW> 6.0", "FLOW> 6.2", "line 2", "6.2, and entries that sum up to 6", "lost block"),
    "no total": ("<TOTAL OD FLOW> 6.0", "", "some_trips", "<TOTAL OD FLOW>", "Add"),
}  # fmt: skip


@pytest.mark.parametrize("case", OF_TRIPS)
def test_tntp_trip_errors_name_their_line(case, tmp_path):
    old, new, place, given, said = OF_TRIPS[case]
    assert old in TRIPS
    text = TRIPS.replace(old, new, 1)
    found = flaws(formats.read_trips, put(tmp_path, text, "some_trips.tntp"))
    matching = [p for p in found if place in p.place and given in p.given]
    assert matching and "some_trips.tntp" in matching[0].place, found
    assert said in f"{matching[0].rule} {matching[0].fix}"


def test_tntp_total_flow_is_compared_within_its_digits(tmp_path):
    rounded = TRIPS.replace("FLOW> 6.0", "FLOW> 7e+000").replace("6.0;", "6.6;")
    assert formats.read_trips(put(tmp_path, rounded)).flow.tolist() == [6.6]
    assert flaws(formats.read_trips, put(tmp_path, rounded.replace("6.6", "6.4")))


OF_FLOWS = {
    "unknown": ("1\t4\t2", "1\t2\t2", "line 3", "link from 1 to 2", "no such one"),
    "missing": ("3\t4\t2\t12\n", "", "some_net.tntp", "no link from 3 to 4", "Add the row"),
    "twice": ("3\t4\t2", "1\t4\t2", "line 5", "link from 1 to 4 once more", "line 3 has it"),
    "text": ("52\n3", "?\n3", "line 3", "'?'", "finite"),
    "column": ("Volume", "Flow", "line 1", "'flow'", "no column 'volume'"),
}


@pytest.mark.parametrize("case", OF_FLOWS)
def test_tntp_flow_file_errors_are_named(case, tmp_path):
    network = formats.read_network(networks.braess(tmp_path)[0])
    old, new, place, given, said = OF_FLOWS[case]
    assert old in FLOW
    found = flaws(formats.read_flows, put(tmp_path, FLOW.replace(old, new, 1)), network)
    assert place in found[0].place and given in found[0].given, found
    assert said in f"{found[0].rule} {found[0].fix}"


def test_tntp_node_file_errors_are_named(tmp_path):
    network = formats.read_network(networks.braess(tmp_path)[0])
    text = NODE.replace("3\t0", "7\t0").replace("4\t0\t0", "1\t0\tnorth")
    found = flaws(formats.read_nodes, put(tmp_path, text), network)
    assert [p.given for p in found] == ["'north'", "the node 7", "no node 3", "no node 4"]
    assert "no rows" in flaws(formats.read_nodes, put(tmp_path, "\n"), network)[0].given


def test_tntp_errors_of_both_files_are_reported_at_once(tmp_path):
    net = put(tmp_path, NET.replace("1\t3\t1", "1\t3\t-1").replace("\t4\t2\t1", "\t4\t2\tx"))
    trips = put(tmp_path, TRIPS.replace("6.0;", "-6.0;"), "some_trips.tntp")
    found = flaws(lambda: traffic.Traffic(net, trips, rate=0.0, rho="much"))
    places = [p.place for p in found]
    assert places == [
        "dvax.models.Traffic(rate)", "dvax.models.Traffic(rho)",
        "some_net.tntp, line 12, column 'capacity'",
        "some_net.tntp, line 8", "some_trips.tntp, line 2", "some_trips.tntp, line 6",
    ]  # fmt: skip


def test_tntp_reports_at_most_twenty_errors(tmp_path):
    rows = "".join(f"1 {k} -1 0 1 0 4 0 0 1 ;\n" for k in range(100, 700))
    found = flaws(formats.read_network, put(tmp_path, NET.replace("LINKS> 5", "LINKS> 605") + rows))
    assert len(found) == 21 and found[-1].given == "1180 more problems"


def test_tntp_missing_file_is_rejected(tmp_path):
    found = flaws(formats.read_network, tmp_path / "none_net.tntp")
    assert "none_net.tntp" in found[0].place and "No such file" in found[0].given


def test_tntp_demand_without_a_path_is_named(tmp_path):
    net, trips = networks.braess(tmp_path)
    both = TRIPS.replace("6.0\n", "9.0\n", 1) + "Origin 2\n 1 : 3.0;\n"
    (one,) = flaws(traffic.Traffic, net, put(tmp_path, both, "some_trips.tntp"))
    assert one.place == "some_trips.tntp, line 8" and "3 trips from 2 to 1" in one.given
    assert "no link leaves 2" in one.rule
    # Node 3 is a zone now, and the only way.
    text = NET.replace("ZONES> 2", "ZONES> 3").replace("NODE> 1", "NODE> 4")
    text = text.replace("LINKS> 5", "LINKS> 4").replace(
        "\t1\t4\t1\t0\t50\t0.02\t1\t0\t0\t1\t;\n", ""
    )
    net = put(tmp_path, text)
    (one,) = flaws(traffic.Traffic, net, put(tmp_path, TRIPS.replace("ZONES> 2", "ZONES> 3"), "t"))
    assert "FIRST THRU NODE" in one.rule
    (one,) = flaws(traffic.Traffic, net, trips)
    assert "3 zones and 2" in one.given


def test_traffic_arrays_are_checked_like_files():
    columns = dict(
        init_node=[1, 1], term_node=[2, 7], capacity=[1.0, -1.0], length=[0.0, 0.0],
        free_flow_time=[1.0, 1.0], b=[0.0, np.nan], power=[1.0, 1.0],
    )  # fmt: skip
    found = flaws(lambda: traffic.Network(2, 2, 1, **columns))
    assert [p.place for p in found] == ["network, link 2"] * 3
    found = flaws(lambda: traffic.Network(2, 2, 1, **(columns | {"b": [[0.0]], "length": [1.0]})))
    assert "(b)" in found[0].place and "1 length" in found[1].given
    found = flaws(lambda: traffic.Trips(2, [1, 1], [2, 2], [1.0, -1.0]))
    assert [p.place for p in found] == ["trips, pair 2"] * 2
    assert "whole numbers" in flaws(lambda: traffic.Trips(2, [1.5], [2], [1.0]))[0].rule
