"""Numbers and texts from elsewhere: the right value, or one line, and never much memory."""

import json
import math
import tracemalloc
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.foreign import exact_number, exact_rate, load_json, load_toml, parse_json, parse_toml, read_text


@pytest.mark.parametrize(
    ("value", "exact"),
    [
        (3, Fraction(3)),
        (-2.5, Fraction(-5, 2)),
        ("1e6", Fraction(10**6)),
        (" 33333333.3 ", Fraction(333333333, 10)),
        ("100000000/3", Fraction(10**8, 3)),
        (".5E-3", Fraction(1, 2000)),
        ("-7.", Fraction(-7)),
        ("0e99", Fraction(0)),
        (Fraction(1, 3), Fraction(1, 3)),
        (np.int64(5), Fraction(5)),
        (np.float32(0.5), Fraction(1, 2)),
        (0.0, Fraction(0)),
    ],
)
def test_exact_numbers(value, exact):
    assert exact_number("rate", value) == exact


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("1e999999999", r"`rate` must lie within 1e±100, got '1e999999999'"),
        ("1e-999999999", "must lie within"),
        ("1e150", "must lie within 1e±100"),
        (1e300, r"must lie within 1e±100, got 1e\+300"),
        (5e-324, "must lie within"),
        pytest.param(10**5000, r"must lie within 1e±100, got 1e\+5000 or so", id="integer of 5000 digits"),
        ("9" * 101, "at most 100 characters"),
        pytest.param("9" * 10**7, "at most 100 characters", id="long text"),
        (math.nan, "`rate` must be finite, got nan"),
        (np.float64(-np.inf), "must be finite, got -inf"),
        ("nan", "must be a number"),
        ("1/0", "must not divide by zero"),
        ("1_000", "must be a number"),
        ("١", "must be a number"),
        ("", "must be a number"),
        (None, "must be a number, got None"),
        (True, "must be a number, got True"),
        ([1.0], "must be a number"),
        (Decimal("1e999999999"), "must be a number"),
    ],
)
def test_numbers_that_are_refused(value, words):
    tracemalloc.start()
    try:
        with pytest.raises(InvalidInputError, match=words) as caught:
            exact_number("rate", value)
        assert tracemalloc.get_traced_memory()[1] < 10**6
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("value", "rate"),
    [
        (1e6, 10**6),
        (1e8 / 3, Fraction(10**8, 3)),
        (Fraction(10**15, 3000001), Fraction(10**15, 3000001)),
        (0.5, Fraction(1, 2)),
    ],
)
def test_rates(value, rate):
    assert exact_rate("rate", value) == rate


@pytest.mark.parametrize("value", [0, -1e6, 1e-9, 1e-100, 1e13, "1e99"])
def test_rates_of_no_receiver(value):
    with pytest.raises(InvalidInputError, match=r"`core:sample_rate` must be a rate from 0\.001 to 1e\+12 a second"):
        exact_rate("core:sample_rate", value)


# -- texts ---------------------------------------------------------------------------------------------------


def test_byte_order_mark_and_umlauts(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b"\xef\xbb\xbf" + '{"name": "Spiegel für Süd"}'.encode())
    assert load_json(path) == {"name": "Spiegel für Süd"}
    path.write_bytes(b"\xef\xbb\xbf" + 'name = "ü" # [[[\nx = 1.5\n'.encode())
    assert load_toml(path) == {"name": "ü", "x": 1.5}


@pytest.mark.parametrize("load", [load_json, load_toml, read_text])
def test_text_that_is_none(tmp_path, load):
    path = tmp_path / "a"
    with pytest.raises(RecordingError, match=r"a: cannot be read: No such file or directory; check the path"):
        load(path)
    with pytest.raises(ScenarioError, match="Is a directory"):
        load(tmp_path, error=ScenarioError)
    with pytest.raises(RecordingError, match="null byte"):
        load("a\0b")
    path.write_bytes(b'{"a":\n "M\xfcller"}')
    with pytest.raises(RecordingError, match=r"a: is not text in UTF-8 \(byte 0xfc at line 2 column 4\)"):
        load(path)
    path.write_bytes(b" " * 1001)
    with pytest.raises(RecordingError, match="a: is longer than 1_000 bytes"):
        load(path, limit=1000)


def test_a_file_without_end_is_not_read_to_its_end():
    with pytest.raises(RecordingError, match="is longer than"):
        load_json("/dev/zero")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1,\n "b" 2}', "s: not valid JSON: .* line 2 column 6 .*; correct it or copy it again"),
        ("", "not valid JSON"),
        ('{"a": [0, ' + "[" * 100, "s: nested deeper than 64 at line 1 column 73; correct it"),
        pytest.param("[" * 10**6, "nested deeper than 64 at line 1 column 65", id="many brackets"),
        (
            '{"a": [1, {"b": ' + "9" * 400 + "}]}",
            r"`a\[1\]\.b` is an integer that does not fit 64 bits \(1e\+400 or so",
        ),
        ('{"a": ' + "9" * 5000 + "}", "not valid JSON: .*4300 digits"),
        ('{"a": [NaN]}', r"`a\[0\]` is nan, which is no JSON number"),
        ('{"a": 1e999}', "`a` is inf"),
    ],
)
def test_json_that_is_refused(text, words):
    with pytest.raises(ScenarioError, match=words) as caught:
        parse_json(text, source="s", error=ScenarioError)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = 1\nb = = 2", r"s: not valid TOML: .*\(at line 2, column 5\); correct it"),
        ("a = " + "[" * 100, "s: nested deeper than 64 at line 1 column 69"),
        pytest.param("x = 1\n" + "a." * 10**6 + "b = 1", "a key of more than 64 parts at line 2", id="long key"),
        ("x = 1\n[" + '"a" . ' * 70 + "b]", "a key of more than 64 parts at line 2"),
        ("[t]\na = " + "9" * 30, r"`t\.a` is an integer that does not fit 64 bits"),
        ("a = " + "9" * 5000, "not valid TOML: .*4300 digits"),
    ],
)
def test_toml_that_is_refused(text, words):
    with pytest.raises(RecordingError, match=words):
        parse_toml(text, source="s")


def test_brackets_within_strings_and_comments_are_none():
    many = "[" * 100
    assert parse_json(json.dumps({'"' + many: "\\" + many}), source="s") == {'"' + many: "\\" + many}
    text = f"""# {many}
a = "\\" {many}"  # '''{many}
b = '{many} " \\'
c = '''
{many}' '''
d = \"\"\"{many}\\\"\"\" " {many}\"\"\"
e = [0.1, 0.2]
"""
    found = parse_toml(text, source="s")
    assert found["a"] == f'" {many}'
    assert found["e"] == [0.1, 0.2]


def test_rows_of_numbers_are_no_keys():
    row = ", ".join(["1.5"] * 1000)
    assert parse_toml(f"a = [{row}]\n[b.c.d]\ne.f = 1", source="s")["b"] == {"c": {"d": {"e": {"f": 1}}}}


@pytest.mark.parametrize("unit", ['\\"', '"', "a", "a.", " ", "'", "''' ", '""" ', "\\", "# ", "[]", "a .\t"])
def test_no_text_takes_time_that_grows_with_its_square(unit):
    """A million characters; were each looked at as often as there are others, this would not end."""
    text = (unit * 10**6)[: 10**6]
    for parse in (parse_json, parse_toml):
        with pytest.raises(RecordingError):
            parse('{"' + text + "=", source="s")
