"""Mistakes of new users raise an `InputError` that names the place and the fix."""

import pytest
from tests import newcomer
from tests.refusals import answers_of, is_a_good_refusal, names_and_words

NAMES = names_and_words(newcomer)


@pytest.fixture(scope="module")
def answers():
    return answers_of(newcomer)


@pytest.mark.parametrize(("name", "words"), NAMES, ids=[name for name, _ in NAMES])
def test_bad_input_is_an_input_error_that_names_place_and_fix(answers, name, words):
    is_a_good_refusal(answers[name], words)
