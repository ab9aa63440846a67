"""Files that are TOML, and that no configuration is: refused before anything is done with them."""

import time

import pytest

from dvax.app.runs.applications.config import read_config
from dvax.app.runs.toml_file import MAX_PARTS, read_toml
from dvax.errors import InputError

NEST = 40
FILES = {
    "an integer of 24000 bits": ("[model]\nalpha = 0x" + "f" * 6000, "at most 64 bits", "model.alpha"),
    "an integer of 400 digits": ("[model]\nx = [[1, " + "9" * 400 + "]]", "at most 64 bits", "model.x"),
    "nested lists": ("[model]\na = " + "[" * NEST + "]" * NEST, "at most 32 deep", "model.a"),
    "nested tables": ("[model]\na = " + "{a=" * NEST + "1" + "}" * NEST, "at most 32 deep", "a.a.a"),
    "a key of many parts": ("\n\n" + ".".join("a" * 100_000) + " = 1", "at most 32 parts", "line 3"),
    "quoted parts": ("a=1\n" + ' . '.join(['"\\""'] * 100_000) + " = 1", "at most 32 parts", "line 2"),
    "a heading of many parts": ("[" + ".".join("a" * 100_000) + "]", "at most 32 parts", "line 1"),
    "many keys": ("\n".join(f"a{k} = 1" for k in range(70_000)), "at most 2000 keys", "case.toml"),
    "many keys below a long one": (
        f"[{'a' * 9000}]\n" + "\n".join(f"a{k} = 1" for k in range(60_000)), "at most 2000 keys", "c",
    ),
    "a long text": ('[model]\nalpha = "' + "a" * 10**6 + '"', "at most 10000 characters", "model"),
    "a long key": ("a" * 10**6 + " = 1", "at most 10000 characters", "case.toml"),
    "a very deep list": ("a = " + "[" * 100_000, "Write it simpler", "case.toml"),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_configuration_beyond_the_limits_is_refused_at_once(name, tmp_path):
    text, rule, place = FILES[name]
    path = tmp_path / "case.toml"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(InputError) as caught:
        read_config(path)
    assert time.process_time() - start < 1.0
    (problem,) = caught.value.problems
    assert rule in str(problem) and place in problem.place and len(str(problem)) < 1000


def test_dots_in_texts_and_numbers_are_no_parts_of_a_key(tmp_path):
    path = tmp_path / "case.toml"
    text = " + ".join(["1.5*s.x"] * 100)
    path.write_text(
        f'a = [{"1.5, " * 200}]\nb = "{text}"\n{".".join("c" * MAX_PARTS)} = 1 # {text}\n'
    )
    assert set(read_toml(path)) == {"a", "b", "c"}
