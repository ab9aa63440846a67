"""A pytest plugin: the processor time of every test, file and folder.

    make test-times                                              # the whole suite
    python -m pytest -p tests.processor_time tests/vi            # a part of it

Processor time is that of the process and of the child processes it has waited for, from the set-up of
a test to its teardown. A fixture that several tests share is therefore counted with the first of them.
`compiled` is the number of programs that XLA compiled or read from the persistent cache, and `xla` is
the elapsed time of that, which other work on the machine lengthens. The figures of all tests go to
`.cache/test_times.tsv`, one line a test, in the order in which the tests end.
"""

import collections
import os
import time
from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[1] / ".cache" / "test_times.tsv"
PROPERTY = "processor_time"
COMPILATION = "/jax/core/compile/backend_compile_duration"
MOST_TESTS = 40


def processor_seconds():
    """Return the processor time of this process and its finished children, in seconds."""
    spent = os.times()
    return time.process_time() + spent.children_user + spent.children_system


def _table(title, rows):
    yield f"{'seconds':>9}{'tests':>7}{'compiled':>10}{'xla':>8}   {title}"
    for name, (seconds, tests, compiled, xla) in rows:
        yield f"{seconds:9.1f}{tests:7d}{compiled:10d}{xla:8.1f}   {name}"


class _Measurement:
    """Measures in each process that runs tests; reports travel to the process that prints."""

    def __init__(self):
        self.compiled, self.xla = 0, 0.0

    def _listen(self, event, seconds, **_):
        if event == COMPILATION:
            self.compiled, self.xla = self.compiled + 1, self.xla + seconds

    @pytest.hookimpl
    def pytest_collection(self):
        # Not at the top of the file: `conftest.py` sets the environment before it imports JAX.
        import jax.monitoring

        jax.monitoring.register_event_duration_secs_listener(self._listen)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.start = processor_seconds(), self.compiled, self.xla
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        if call.when == "teardown":
            start, compiled, xla = self.start
            figures = processor_seconds() - start, self.compiled - compiled, self.xla - xla
            item.user_properties.append((PROPERTY, figures))
        return (yield)


class _Report:
    """Collects the figures of all processes, writes them down and prints the sums."""

    def __init__(self):
        self.tests = {}
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text("seconds\tcompiled\txla\ttest\n")

    def pytest_runtest_logreport(self, report):
        figures = dict(report.user_properties).get(PROPERTY)
        if report.when == "teardown" and figures is not None:
            seconds, compiled, xla = figures
            self.tests[report.nodeid] = seconds, 1, compiled, xla
            with RESULTS.open("a") as results:
                results.write(f"{seconds:.3f}\t{compiled}\t{xla:.3f}\t{report.nodeid}\n")

    def pytest_terminal_summary(self, terminalreporter):
        def of(name):
            sums = collections.defaultdict(lambda: (0.0, 0, 0, 0.0))
            for test, figures in self.tests.items():
                key = name(test)
                sums[key] = tuple(a + b for a, b in zip(sums[key], figures))
            return sorted(sums.items(), key=lambda row: -row[1][0])

        files = of(lambda test: test.split("::")[0])
        folders = of(lambda test: "/".join(test.split("::")[0].split("/")[:-1]))
        whole = of(lambda test: "all tests")
        longest = of(lambda test: test)[:MOST_TESTS]
        terminalreporter.section("processor time")
        tables = {"test": longest, "file": files, "folder": folders, "sum": whole}
        for title, rows in tables.items():
            terminalreporter.write_line("\n".join(_table(title, rows)) + "\n")


def pytest_configure(config):
    """Register the measurement where tests run, and the report where results are printed."""
    worker = hasattr(config, "workerinput")
    if not worker:
        config.pluginmanager.register(_Report(), "processor-time-report")
    if worker or not config.getoption("numprocesses", None):
        config.pluginmanager.register(_Measurement(), "processor-time-measurement")
