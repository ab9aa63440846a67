"""Problems of a configuration that are found in one pass, though one of them could hide another."""

import pytest

import dvax
from dvax.app.runs.applications.config import read_config

CODE = """
from pathlib import Path
import dvax

def build(belt: float = 1.0, mu: float = 0.5, record: Path | None = None):
    if record is not None:
        record.read_text()
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, mu),
        f=lambda t, x, u, args: belt - u, h=lambda t, x, u, args: x - u,
    )
    return dvax.models.Model(problem, 0.0, 1.0)

def build_required(belt: float):
    return build(belt)
"""


def places(folder, table):
    """The keys that the problems name, in their order."""
    (folder / "bolt.py").write_text(CODE)
    (folder / "bolt.toml").write_text(f'[model]\npython = "bolt.py:build"\n{table}')
    with pytest.raises(dvax.InputError) as caught:
        read_config(folder / "bolt.toml", allow_code=True)
    return [problem.place.removeprefix("bolt.toml: ") for problem in caught.value.problems]


@pytest.mark.parametrize(("table", "keys"), [
    ('rtol = -1\nframes = 0\nt_end = -1.0\n[model.parameters]\nbellt = 2\nmu = "x"\n',
     ["model.rtol", "model.frames", "model.parameters.bellt", "model.parameters.mu", "model.t_end"]),
    ('method = "RK45"\nt_end = -1.0\n', ["model.method", "model.t_end"]),
    ('t_end = -1.0\nenergi = true\n[output]\npgn = true\n',
     ["model.energi", "output.pgn", "model.t_end"]),
    ('method = "RK45"\n[model.parameters]\nmu = -1.0\n',
     ["model.method", "bolt.py, line 9: dvax.sets.Box(lower, upper)"]),
    # Without the file nothing can be built, and the time of the model is not known.
    ('frames = 0\nt_end = -1.0\n[model.parameters]\nmu = "x"\nrecord = "none.csv"\n',
     ["model.frames", "model.parameters.record", "model.parameters.mu"]),
    ('[model.parameters]\nrecord = "none.csv"\n', ["model.parameters.record"]),
])  # fmt: skip
def test_problems_of_keys_parameters_files_and_times_are_found_together(tmp_path, table, keys):
    assert places(tmp_path, table) == keys


def test_problem_of_a_required_parameter_hides_none_of_the_keys(tmp_path):
    table = "frames = 0\nt_end = -1.0\n[model.parameters]\nbelt = true\n"
    table = f'function = "build_required"\n{table}'
    (tmp_path / "bolt.py").write_text(CODE)
    (tmp_path / "bolt.toml").write_text(f'[model]\npython = "bolt.py"\n{table}')
    with pytest.raises(dvax.InputError) as caught:
        read_config(tmp_path / "bolt.toml", allow_code=True)
    assert len(caught.value.problems) == 2


def test_missing_data_of_a_ready_model_is_found_beside_a_wrong_key(tmp_path):
    (tmp_path / "run.toml").write_text(
        '[model]\nname = "frame"\nrecord = "none.at2"\nperiod = 1.0\ndamping = 0.05\nmethod = "RK45"\n'
    )
    with pytest.raises(dvax.InputError) as caught:
        read_config(tmp_path / "run.toml")
    places = [problem.place for problem in caught.value.problems]
    assert places == ["run.toml: model.method", "run.toml: model.record"]
