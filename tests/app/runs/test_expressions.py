"""The expression language evaluates formulas, and rejects everything else."""

import math
import pickle
import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvax.app.runs.expressions import FUNCTIONS, compile_expression
from dvax.errors import InputError

T, S = 0.7, np.linspace(-2.0, 3.0, 11)

SAME_AS_NUMPY = {
    "t": T,
    "2": 2.0,
    "-t + 3*s - s/4": -T + 3 * S - S / 4,
    "s**2 + 2**0.5": S**2 + math.sqrt(2),
    "sin(2*pi*t) + cos(s) + tan(t) + tanh(s)": math.sin(2 * math.pi * T)
    + np.cos(S)
    + math.tan(T)
    + np.tanh(S),
    "sinh(s)*cosh(s)": np.sinh(2 * S) / 2,
    "exp(-t) * log(e) + sqrt(abs(s))": math.exp(-T) + np.sqrt(np.abs(S)),
    "arctan(s) - atan(s) + arctan2(s, 1)": np.arctan(S),
    "minimum(s, 1) + maximum(s, 1)": S + 1,
    "clip(s, -1, 1)": np.clip(S, -1, 1),
    "where(s < 0, -s, s)": np.abs(S),
    "where(1 >= 2, t, s)": S,
    "step(s) + sign(s) + floor(s)": (S >= 0) + np.sign(S) + np.floor(S),
    "(1\n + t)": 1 + T,
}


@pytest.mark.parametrize("text", SAME_AS_NUMPY)
def test_expression_value_is_that_of_the_formula(text):
    expression = compile_expression(text)
    expected = SAME_AS_NUMPY[text]
    with jax.enable_x64(True):
        traced = jax.jit(lambda t, s: expression(t=t, s=s))(T, S)
        assert traced.dtype == jnp.float64
        np.testing.assert_allclose(traced, expected, rtol=1e-14, atol=1e-14, err_msg=text)
    np.testing.assert_allclose(expression.numpy(t=T, s=S), expected, rtol=1e-14, atol=1e-14)


def test_expression_functions_are_all_tested():
    used = " ".join(SAME_AS_NUMPY)
    assert all(f"{name}(" in used for name in FUNCTIONS)


def test_expression_supports_derivatives_and_batches():
    expression = compile_expression("t**2 * sin(s) + where(s > 0, s**3, -s)")
    with jax.enable_x64(True):
        slope = jax.vmap(jax.grad(lambda s: expression(t=2.0, s=s)))(jnp.asarray(S))
    expected = 4 * np.cos(S) + np.where(S > 0, 3 * S**2, -1.0)
    np.testing.assert_allclose(slope, expected, rtol=1e-13)
    with jax.enable_x64(True):
        at_zero = float(jax.grad(lambda t: compile_expression("t**2 + t**1")(t=t, s=0.0))(0.0))
    assert at_zero == 1.0, "a whole power has its derivative at zero too"


def test_expression_integers_are_real_numbers():
    assert float(compile_expression("1/t**2")(t=2, s=0)) == 0.25


def test_expression_step_keeps_nan_and_is_one_at_zero():
    step = compile_expression("step(t)")
    assert step.numpy(t=0.0, s=0.0) == 1.0 and step.numpy(t=-1e-300, s=0.0) == 0.0
    assert np.isnan(step.numpy(t=math.nan, s=0.0))


def test_expression_is_hashable_and_comparable():
    a, b = compile_expression("t + s"), compile_expression("t + s")
    assert a == b and hash(a) == hash(b)
    assert a != compile_expression("t + s", ("t", "s", "r"))
    assert a != compile_expression("s + t")
    assert a.uses == {"t", "s"} and compile_expression("2*t").uses == {"t"}
    again = pickle.loads(pickle.dumps(a))  # noqa: S301 - a round trip of our own bytes
    assert again == a and again.numpy(t=1.0, s=2.0) == 3.0


def test_expression_call_requires_exactly_its_variables():
    with pytest.raises(TypeError, match="is a function of t, s; it was called with t"):
        compile_expression("t")(t=1.0)


ATTACKS = {
    "__import__('os').system('true')": "no such function|only the functions",
    "().__class__.__bases__[0].__subclasses__()": "only the functions",
    "t.__class__": "an attribute",
    "(lambda: 1)()": "only the functions",
    "[x for x in (1,)]": "a ListComp",
    "eval('1')": "no such function",
    "open('/etc/passwd').read()": "only the functions",
    "getattr(t, 'real')": "no such function",
    "f'{t}'": "a formatted text",
    "'a'*10**9": "a str is not a number",
    "9**9**9**9": "at most 64",
    "2**-65": "at most 64",
    "2.0**64 * 1e300": "its value is inf",
    "1e999": "finite in double precision",
    "9" * 400: "finite in double precision",
    "1/0": "its value is inf",
    "log(0-1)": "its value is nan",
    "1j": "a complex is not a number",
    "True": "a bool is not a number",
    "None": "a NoneType is not a number",
    "t if s else 1": "an if",
    "t and s": "and/or",
    "(t := 3)": r"an assignment",
    "t[0]": "a subscript",
    "sin(*s)": "a star",
    "sin(x=t)": "exactly 1 plain argument",
    "where(t < s < 1, 1, 2)": "one comparison",
    "where(t, 1, 2)": "one comparison",
    "where(t == 1, 1, 2)": "one comparison",
    "t < 1": "a comparison is no number",
    "t % 2": "this operator",
    "~t": "this operator",
    "t ** s": "an exponent is a constant",
    "sin": "sin is a function",
    "t(1)": "t is a variable",
    "import os": "not a formula",
    "t; s": "not a formula",
    "t # note": "plain ASCII",
    "t\x00": "plain ASCII",
    "ｔ + 1": "plain ASCII",
    "": "an empty text",
    "   ": "an empty text",
    "1if t else 2": "not a formula",
    "(" * 3000: "not a formula|nests at most",
    "-" * 4000 + "1": "nests at most|not a formula",
    "t" + "+t" * 80: "nests at most 64",
    "(" * 60 + "t" + ")" * 60 + "+sin(" * 70 + "t" + ")" * 70: "nests at most 64",
    "minimum(" + ",".join(["t"] * 600) + ")": "at most 512 nodes",
    "1+" * 3000 + "1": "at most 4096 characters",
    "await t": "not a formula|an Await|a Await",
    "{t}": "a Set",
    "t @ s": "this operator",
}


@pytest.mark.parametrize(
    "text", ATTACKS, ids=lambda text: text[:24].encode("unicode_escape").decode()
)
def test_expression_rejects_invalid_formulas_with_a_reason(text):
    with pytest.raises(InputError, match=ATTACKS[text]):
        compile_expression(text)


def test_expression_error_names_the_column():
    with pytest.raises(InputError) as caught:
        compile_expression("   t + sine(t)\n + rubbish", place="load.expression")
    assert [p.place for p in caught.value.problems] == [
        "load.expression, column 8",
        "load.expression, column 19",
    ]
    assert caught.value.problems[0].fix == "Did you mean 'sin'?"


def test_expression_rejects_values_that_are_not_strings():
    with pytest.raises(InputError, match="an expression is a text"):
        compile_expression(3)


TOKENS = (
    "t s pi e 0 1 2.5 1e308 1e999 9 + - * / ** ** ( ) ( ) , < <= == sin( cos( log( sqrt( exp( "
    "where( clip( step( maximum( foo lambda : := [ ] { } . .real __import__ ' \" f' % // ~ not and "
    "if else await yield \\ \n \t # 0x 0b1 1_0 é ａ @ ! $ ` ; = True None ... 1j b'x'"
).split(" ")


def parses_safely(text: str) -> bool:
    """Return whether the text is a formula, which is then evaluated; only InputError may be raised."""
    try:
        expression = compile_expression(text)
    except InputError as refused:
        assert refused.problems, text
        return False
    value = expression.numpy(t=0.3, s=np.array([0.5, 2.0]))
    assert value.dtype == np.float64 and value.shape in {(), (2,)}, text
    return True


@pytest.mark.parametrize("cases", [20_000, pytest.param(300_000, marks=pytest.mark.thorough)])
def test_expression_random_tokens_raise_input_errors_only(cases):
    dice = random.Random(cases)
    passed = 0
    for _ in range(cases):
        joint = dice.choice(("", " "))
        passed += parses_safely(joint.join(dice.choices(TOKENS, k=dice.randint(1, 14))))
    assert cases / 200 < passed < cases, "the soup reaches both verdicts"


@pytest.mark.thorough
@settings(max_examples=500, deadline=None, database=None, derandomize=True)
@given(st.text(max_size=80) | st.lists(st.sampled_from(TOKENS), max_size=40).map("".join))
def test_expression_arbitrary_text_raises_input_errors_only(text):
    parses_safely(text)
