"""The time from a move of a slider to the answer, for the contact law of `dvax explore`."""

import http.client
import json
import threading
import time
from typing import Any

from ..clock import spread
from ..section import Comparison, Section, Table, Target

_MOST_SECONDS = 0.1


def run(full: bool) -> Section:
    from dvax.app.explore.contact import ContactSubject, load_default
    from dvax.app.explore.server import Server

    subject = ContactSubject(load_default())
    points = subject.inputs.boundary.size
    section = Section(
        title="explore: from a move of a slider to the answer",
        fair=(
            "No peer. The page of the contact law with its defaults, asked over HTTP as by its script: "
            "solution, error bound, prediction, all drawings as JSON. Programs are compiled before. "
            "Drawing in the browser is not in it."
        ),
    )
    server = Server(subject)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port)
    base = {p.key: p.value for p in subject.parameters}
    key, rounds = "model.b_x", 41 if full else 21

    def ask(path: str, body: dict[str, Any]) -> tuple[float, bytes]:
        started = time.perf_counter()
        headers = {"Content-Type": "application/json"}
        connection.request("POST", f"/{server.key}/{path}", json.dumps(body), headers)
        answer = connection.getresponse().read()
        return time.perf_counter() - started, answer

    def solve(value: float, is_rest: bool) -> tuple[float, bytes]:
        values = {**base, key: value}
        start = values if is_rest else base
        body = {"values": values, "base": start, "slider": key, "derivative": is_rest, "frame": 50}
        return ask("solve", body)

    def move(value: float) -> tuple[float, bytes]:
        return solve(value, False)

    def rest(value: float) -> tuple[float, bytes]:
        return solve(value, True)

    plane = {"values": base, "across": "model.b_x", "upward": "model.d_u"}
    rest(base[key])  # compiles the solve and the derivative
    ask("map", plane)
    answer = json.loads(move(0.9)[1])
    frame = {"answer": answer["answer"], "frame": 30}
    measured = {
        "a move while dragging": [move(0.5 + 0.01 * k) for k in range(rounds)],
        "a rest, with the derivative at new values": [rest(0.9 + 0.01 * k) for k in range(rounds)],
        "a map of stability": [ask("map", plane) for _ in range(5)],
    }
    # The server keeps the last answers.
    frame["answer"] = json.loads(move(0.9)[1])["answer"]
    measured["another saved time"] = [ask("frame", frame) for _ in range(rounds)]
    rows = []
    for name, samples in measured.items():
        found = spread([seconds for seconds, _ in samples])
        target = Target("≤", _MOST_SECONDS, found.middle, " s") if "drag" in name else None
        section.comparisons.append(
            Comparison(
                case=f"{name}, {points} points", versus="-", dvax=found.middle, other=None,
                target=target, rounds=len(samples),
            )
        )  # fmt: skip
        size = len(samples[-1][1]) / 1024
        rows.append((name, f"{found.low:.3f} s", f"{found.high:.3f} s", f"{size:.0f} KiB"))
    section.tables.append(
        Table("Answers", ("question", "shortest", "longest", "size of the answer"), rows)
    )
    sizes = {name or "the page": len(content) for name, (content, _) in server.pages.items()}
    section.tables.append(
        Table("Files", ("file", "size"), [(n, f"{s / 1024:.0f} KiB") for n, s in sizes.items()])
    )
    server.shutdown()
    server.server_close()
    return section
