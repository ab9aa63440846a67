"""Valid inputs of every kind, made here: configurations of every model with their data."""

import io
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from dvax.app.runs.applications.config import APPLICATIONS, module_of
from dvax.app.runs.schema import SECTIONS

CONTACT = """[units]
time = "s"
length = "mm"
indentation = "um"
pressure = "MPa"
[model]
name = "contact"
alpha = "1 1/s"
beta = "2 MPa/um"
b_x = 0.8
b_u = 0.6
d_x = 0.3
d_u = "0.5 1/s"
kappa0 = "2 MPa"
[boundary]
length = "20 mm"
points = 8
[demand]
profile = { file = "strip.npy", per_unit = "1 um" }
expression = "1 - 0.4*exp(-t/4)"
[load]
expression = "1 + 0.3*cos(pi*s/20)"
[load.series]
file = "load.csv"
column = "load"
kind = "linear"
[initial]
value = 0.0
companion = "1 + 0.5*sin(pi*s/20)"
[time]
end = "2 s"
frames = 4
[solver]
method = "ETD2RK"
dt = "0.5 s"
[output]
points_of_interest = [2.5, 7.5]
"""
NODES = """[model]
alpha = 1.0
beta = 2.0
b_x = 0.8
b_u = 0.6
d_x = 0.3
d_u = 0.5
kappa0 = 2.0
[boundary]
file = "nodes.csv"
[demand.profile]
file = "profile.csv"
column = "height"
[load.series]
file = "quake.at2"
per_unit = "30 m/s"
[time]
end = 0.05
frames = 2
[solver]
rtol = 1e-6
"""
RECTANGLE = """[model]
alpha = 1.0
beta = 2.0
b_x = 0.8
b_u = 0.6
d_x = 0.3
d_u = 0.5
kappa0 = 2.0
[boundary]
lengths = [2.0, 1.0]
points = [4, 2]
[demand]
profile = { file = "strip.npy" }
expression = "1 + 0.1*s1*s2 + t"
knots = [0.25]
[load]
value = 0.1
[time]
end = 1.0
frames = 2
"""
CIRCUIT = """[model]
name = "circuit"
netlist = "tank.cir"
t_end = "1 ms"
frames = 4
r_on = 0.1
g_leak = 1e-9
rtol = 1e-6
"""
FRAME = """[model]
name = "frame"
record = "quake.at2"
period = "0.5 s"
damping = 0.05
yield_ratio = 0.5
viscosity_ratio = "10 ms"
atol = 1e-6
"""
TRAFFIC = """[model]
name = "traffic"
network = "road_net.tntp"
trips = "road_trips.tntp"
nodes = "road_node.tntp"
toll_weight = 0.0
distance_weight = 0.1
rate = 1.0
days = 3.0
gap = 1e-10
[[model.incidents]]
init_node = 1
term_node = 3
remaining = 0.5
start = 1.0
end = 2.0
"""
MARKET = """[model]
name = "market"
data = "market"
start_hour = 3
hours = 5
speed = 6.0
reference_price = 40.0
elasticity = 0.3
"""
BLOCK = """[model]
name = "fem-contact"
width = 8.0
height = 4.0
fine_half_width = 0.5
fine = 2
coarse = 2
layers = 2
growth = 1.18
indentation = 0.01
stiffness = 100.0
pressure_cap = 10.0
radius = 10.0
end = 1.0
frames = 2
"""
MESH = """[model]
name = "fem-contact"
mesh = "block.msh"
contact = "contact"
clamped = "clamped"
end = 1.0
frames = 2
dt = 0.5
[output]
report = true
png = false
checkpoint_seconds = 5.0
"""

TANK = """* a tank that a diode damps
C1 1 0 1u IC=10
L1 1 0 10m
D1 1 0 R=1k
R1 1 2 1k
V1 2 0 SIN(0 10 1k 0 10 90)
I1 1 0 PWL(0 0 1m 5m 2m 0)
V2 3 0 PULSE(0 5 0 1n 1n 5u 10u)
R2 3 1 2.2k ; a load
D2 0 1
"""
QUAKE = """A record
of no place
The units are (g)
NPTS=  5, DT= .02000 SEC
   0.00100   0.00200  -0.00300
 4.0E-03   0.00500
"""
ROAD_NET = """<NUMBER OF ZONES> 2
<NUMBER OF NODES> 4
<FIRST THRU NODE> 1
<NUMBER OF LINKS> 5
<END OF METADATA>

~ init_node term_node capacity length free_flow_time b power speed toll link_type ;
 1 3 1 1 1.5 0.15 4 0 0 1 ;
 1 4 1 2 50 0.02 1 0 0 1 ;
 3 2 1 2 50 0.02 1 0 1 1 ;
 3 4 1 3 10 0.1 1 0 0 1 ;
 4 2 1 1 1.5 0.15 4 0 0 1 ;
"""
ROAD_TRIPS = """<NUMBER OF ZONES> 2
<TOTAL OD FLOW> 6.0
<END OF METADATA>

Origin 1
    1 :      0.0;     2 :      6.0;
"""
ROAD_NODE = "Node X Y ;\n1 0.0 0.0 ;\n2 1.0 1.5 ;\n3 1e3 -2 ;\n4 5 5 ;\n"
ROAD_FLOW = "From To Volume Cost\n1 3 1 2\n1 4 1 2\n3 2 1 2\n3 4 1 2\n4 2 1 2\n"
LOAD = "time [s],load [um/s]\n0,0.5\n0.7,1.5\n1,-0.25\n2.5,1\n"
PROFILE = "s [mm],height [mm]\n0,0\n10,0.01\n20,0\n"
NODE_ROWS = "s [mm],weight [mm]\n" + "".join(f"{i + 0.5},1\n" for i in range(8))
_CLOCK = "Year,Month,Day,Period"
UNITS = """GEN UID,Bus ID,Unit Type,Fuel,PMax MW,Fuel Price $/MMBTU,HR_incr_1,HR_incr_2,HR_incr_3
101_CC_1,101,CC,NG,300,4.0,7000,7200,7500
102_WIND_1,102,WIND,Wind,150,0,0,0,0
201_CT_1,201,CT,Oil,50,10.0,9500,9600,11500
202_PV_1,202,PV,Solar,80,0,0,0,0
201_HYDRO_1,201,HYDRO,Hydro,500,0,NA,NA,NA
"""


def _hourly(names: str, row: str) -> str:
    return f"{_CLOCK},{names}\n" + "".join(f"2021,3,14,{k + 1},{row}\n" for k in range(10))


def _npy(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def _npz(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, values=values)
    return stream.getvalue()


def bomb(size: int) -> bytes:
    """Return an NPZ file whose one array expands to `size` zeros."""
    stream = io.BytesIO()
    with (
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w") as entry,
    ):
        np.lib.format.write_array_header_1_0(
            entry, {"descr": "|u1", "fortran_order": False, "shape": (size,)}
        )
        for _ in range(size // 2**20):
            entry.write(bytes(2**20))
    return stream.getvalue()


# Two quadrilaterals, held below and touched above.
GMSH_2 = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
3
1 7 "contact"
1 4 "clamped"
2 1 "block"
$EndPhysicalNames
$Nodes
6
1 -1 -1 0
2 0 -1 0
3 1 -1 0
4 -1 0 0
5 0 0 0
6 1 0 0
$EndNodes
$Elements
6
1 3 2 1 1 1 2 5 4
2 3 2 1 1 2 3 6 5
3 1 2 7 1 4 5
4 1 2 7 1 5 6
5 1 2 4 2 1 2
6 1 2 4 2 2 3
$EndElements
"""
GMSH_4 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
1 7 "contact"
1 4 "clamped"
2 1 "block"
$EndPhysicalNames
$Entities
0 2 1 0
1 -1 -1 0 1 1 0 1 7 0
2 -1 -1 0 1 1 0 1 4 0
1 -1 -1 0 1 1 0 1 1 0
$EndEntities
$Nodes
1 6 1 6
2 1 0 6
1
2
3
4
5
6
-1 -1 0
0 -1 0
1 -1 0
-1 0 0
0 0 0
1 0 0
$EndNodes
$Elements
3 6 1 6
1 1 1 2
1 4 5
2 5 6
1 2 1 2
3 1 2
4 2 3
2 1 3 2
5 1 2 5 4
6 2 3 6 5
$EndElements
"""
ABAQUS = """*HEADING
*NODE
1, -1., -1., 0.
2, 0., -1., 0.
3, 1., -1., 0.
4, -1., 0., 0.
5, 0., 0., 0.
6, 1., 0., 0.
*ELEMENT, TYPE=T3D2, ELSET=contact
3, 4, 5
4, 5, 6
*ELEMENT, TYPE=T3D2, ELSET=clamped
5, 1, 2
6, 2, 3
*ELEMENT, TYPE=CPS4, ELSET=block
1, 1, 2, 5, 4
2, 2, 3, 6, 5
"""
MEDIT = """MeshVersionFormatted 1
Dimension 2
Vertices
6
-1 -1 0
0 -1 0
1 -1 0
-1 0 0
0 0 0
1 0 0
Edges
4
4 5 7
5 6 7
1 2 4
2 3 4
Quadrilaterals
2
1 2 5 4 1
2 3 6 5 1
End
"""


@dataclass(frozen=True)
class Seed:
    """A valid configuration `text` named `name`, the data files that it reads, and what `read_config`
    needs beyond it."""

    name: str
    text: str
    data: tuple[str, ...]
    allow_code: bool = False


SEEDS = (
    Seed("contact", CONTACT, ("load.csv", "strip.npy")),
    Seed("nodes", NODES, ("nodes.csv", "profile.csv", "quake.at2")),
    Seed("rectangle", RECTANGLE, ("strip.npy",)),
    Seed("circuit", CIRCUIT, ("tank.cir",)),
    Seed("frame", FRAME, ("quake.at2",)),
    Seed("traffic", TRAFFIC, ("road_net.tntp", "road_trips.tntp", "road_node.tntp")),
    Seed("market", MARKET, ("market/gen.csv", "market/DAY_AHEAD_regional_Load.csv",
                            "market/DAY_AHEAD_wind.csv", "market/DAY_AHEAD_pv.csv")),
    Seed("block", BLOCK, ()),
    Seed("mesh", MESH, ("block.msh",)),
    Seed("abaqus", MESH.replace("block.msh", "block.inp"), ("block.inp",)),
    Seed("medit", MESH.replace("block.msh", "block.mesh").replace('"contact"', '"7"')
         .replace('"clamped"', '"4"'), ("block.mesh",)),
    Seed("gmsh4", MESH.replace("block.msh", "four.msh"), ("four.msh",)),
    Seed("python", (files("dvax.app.runs") / "new" / "spring.toml.txt").read_text("utf-8"), (), True),
)  # fmt: skip


def data_files() -> dict[str, bytes]:
    """Return the valid data files by name."""
    texts = {
        "load.csv": LOAD, "profile.csv": PROFILE, "nodes.csv": NODE_ROWS, "tank.cir": TANK,
        "quake.at2": QUAKE, "road_net.tntp": ROAD_NET, "road_trips.tntp": ROAD_TRIPS,
        "road_node.tntp": ROAD_NODE, "road_flow.tntp": ROAD_FLOW, "block.msh": GMSH_2,
        "four.msh": GMSH_4, "block.inp": ABAQUS, "block.mesh": MEDIT, "market/gen.csv": UNITS,
        "market/DAY_AHEAD_regional_Load.csv": _hourly("1,2", "250,150.5"),
        "market/DAY_AHEAD_wind.csv": _hourly("102_WIND_1", "70.25"),
        "market/DAY_AHEAD_pv.csv": _hourly("202_PV_1", "40"),
        "spring.py": (files("dvax.app.runs") / "new" / "spring.py.txt").read_text("utf-8"),
        "empty.csv": "", "empty.npy": "",
    }  # fmt: skip
    return {
        **{name: text.encode() for name, text in texts.items()},
        "strip.npy": _npy(np.linspace(-0.5, 1.5, 8)),
        "packed.npy": _npz(np.linspace(-0.5, 1.5, 8)),
    }


def write_folder(folder: Path) -> Path:
    """Write the data files, and places that no configuration may read, into `folder`/in; return it."""
    inside = folder / "in"
    for name, content in data_files().items():
        (inside / name).parent.mkdir(parents=True, exist_ok=True)
        (inside / name).write_bytes(content)
    outside = folder / "elsewhere"
    outside.mkdir()
    (outside / "secret.csv").write_text(LOAD)
    (folder / "out.csv").write_text(LOAD)
    links = {
        "link_out": "../out.csv", "link_in": "load.csv", "link_gone": "none", "link_loop": "link_loop",
        "link_zero": "/dev/zero", "link_dir": "../elsewhere",
    }  # fmt: skip
    for name, target in links.items():
        (inside / name).symlink_to(target)
    (inside / "folder").mkdir()
    os.mkfifo(inside / "fifo")
    for name in ("huge.csv", "huge.npy"):
        with (inside / name).open("wb") as file:
            file.truncate(2**40)
    (inside / "closed.csv").write_text(LOAD)
    (inside / "closed.csv").chmod(0)
    return inside


def all_keys() -> tuple[str, ...]:
    """Return the keys of every table of every model."""
    sections = [*SECTIONS.values(), *(module_of(name).APPLICATION.section for name in APPLICATIONS)]
    names = {name for section in sections for name in section.model_fields} | set(SECTIONS)
    inner: Mapping[str, tuple[str, ...]] = {
        "series": ("file", "column", "time_column", "per_unit"),
        "incidents": ("init_node", "term_node", "remaining", "start", "end"),
    }
    return tuple(sorted(names.union(*inner.values())))
