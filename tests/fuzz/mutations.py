"""Mutations of texts and of bytes. Each is named by a number, from which it is made again."""

# ruff: noqa: E501  (tables of samples)

import random
import re

NUMBERS = (
    "0 -0.0 0.0 1 -1 2 3 0.5 1e308 -1e308 1.8e308 1e-320 5e-324 1e400 nan -nan inf -inf true false 7e-10 "
    "1e15 1e-15 1e-300 40 1e100 2147483648 -2147483649 4294967296 9223372036854775807 "
    "9223372036854775808 -9223372036854775809 10000000000 1000000000 0x10 0xffffffffffffffffffff 0o7 0b1 "
    "1_0 1__0 01 +1 .5 5. 1e5 1E5 1e+5 1e"
).split()
HUGE = (
    "9" * 400,
    "-" + "9" * 400,
    "9" * 5000,
    "0x" + "f" * 6000,
    "1." + "0" * 9000,
    "0." + "9" * 3000,
)
STRINGS = (
    "", " ", "x", "t", "s", "contact", "circuit", "traffic", "inf", "nan", "true", "5", "5 kg", "1e999 m",
    "-1 s", "0 s", "5 m/s/s/s", "5 s**9", "1e300 s**9", "1 s**-9", "3 um", "2 MPa", "2 Mpaskal", "1 degC",
    "5 %", "1 /s", "5  ms", "5ms", "5 µs", "٣ s", "1 s*s", "1 (s)", "1 ((s))", "s", "1e5 year", "1e-320 s",
    "1 ys", "1 Ys**9", "1 dBm", "1 ppm", "1 Å", "1 count", "sin(t)", "1/0", "9**9**9", "s1*s2", "1/(s-s)",
    "__import__('os')", "t.real", "sqrt(0-s)", "exp(800)", "1e308*10*s", "where(s<1, s, 2)", "\x00", "a\x00b",
    "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "\r\n", "\t", "\u202eabc", "\ufeff", "\ud7ff", "\U0001f600",
    "é", "[/red]", "[bold]", "[/]", "{0}", "%s", "%n", "$HOME", "`id`", "'", '"', "\\", "a" * 5000,
    "(" * 200, "1+" * 3000 + "1", "é" * 2000, "1 " + "s " * 60, "1 " + "s" * 5000, "9" * 400 + " s",
    "ETD1", "ETD2RK", "ETD4RK", "ExpRosenbrock", "DormandPrince", "Implicit", "PiecewiseLinear", "ETD2",
    "Auto", "Projection", "SemismoothNewton", "linear", "cubic", "constant", "spring.py:build",
    "spring.py:nothing", "spring.py:", ":build", "spring.py:os", "spring.py:1", "build", "40 N/m", "40 N",
)  # fmt: skip
PATHS = (
    ".", "..", "../out.csv", "../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem",
    "/", "~", "~root/x", "link_out", "link_in", "link_gone", "link_loop", "link_zero", "link_dir/secret.csv",
    "folder", "folder/", "fifo", "huge.csv", "huge.npy", "closed.csv", "none.csv", "a/b/c", "load.csv/",
    "load.csv/x", "./load.csv", "folder/../load.csv", "C:\\x", "\\\\host\\x", "file:///etc/passwd", "con",
    "load.csv\x00", "\x00", "a\nb", "\u202e", "x" * 300, "x/" * 3000, "x" * 70000, "*", "load.csv ", "-o",
    "empty.csv", "empty.npy", "load.csv", "strip.npy", "tank.cir", "quake.at2", "road_net.tntp",
    "road_trips.tntp", "road_node.tntp", "market", "block.msh", "run.toml", "spring.py",
)  # fmt: skip
STRUCTURES = (
    "[]", "{}", "[[]]", "[1, 2]", "[1.0]", "[0.0, 1.0]", "[[1, 2], [3]]", "[true]", "['a', 1]", "{ a = 1 }",
    "{ file = 'load.csv' }", "{ file = 'strip.npy', per_unit = '1 um' }", "{ file = 3 }",
    "{ file = 'load.csv', kind = 'cubic' }", "{ file = 'quake.at2', per_unit = '30 um/s' }",
    "{ file = 'link_out', column = 'load' }", "[{ a = [] }]", "[" * 60 + "]" * 60, "[" * 400 + "]" * 400,
    "{a=" * 60 + "1" + "}" * 60, "{a=" * 3000 + "1" + "}" * 3000, "[" + "1," * 5000 + "]",
    "[" + "{a=1}," * 1000 + "]", "1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "1979-05-27 07:32:00.999999",
    "0001-01-01T00:00:00+23:59", "2024-02-30", "'''\na\n'''", '"""\\\n  a"""', "[1, [2, [3, [4]]]]",
    "[10000000000, 10000000000]", "[-1, 4]", "[4, 0]", "[4, 4]", "[nan, 1]", "[1e308, 1e308]", "['1 mm', '2 mm']",
)  # fmt: skip
ODD_KEYS = (
    '""', '"a.b"', '"\\u202e"', '"\\u0000"', '"\\u001b[31m"', '"[/red]"', '"a\\nb"', "ä", "a b", "a.b.c",
    "__class__", "model", "name", "-", "1", "x" * 3000, ".".join("a" * 500), ".".join("a" * 20000), "'''a'''",
)  # fmt: skip
LINES = (
    "[model]", "[model", "[[model]]", "[model.name]", "[[model.incidents]]", "[load]", "[[load]]", "[]", "[a.b]",
    "[" + ".".join("a" * 3000) + "]", "=", "= 1", "a", "a =", "# comment \x01", "[output]", "[solver]", "[units]",
    "[model.parameters]", "\x00", "\ufeff", "a = 1 b = 2", 'a = "unfinished', "a = '''unfinished", "a = [1,",
)  # fmt: skip


def quoted(text: str) -> str:
    """Return a basic string of TOML."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + re.sub(r"[\x00-\x1f\x7f]", lambda m: f"\\u{ord(m[0]):04x}", escaped) + '"'


def any_value(dice: random.Random) -> str:
    """Return the text of some value of TOML, valid or not."""
    kind = dice.randrange(10)
    if kind < 3:
        return dice.choice(NUMBERS)
    if kind == 3:
        return dice.choice(HUGE)
    if kind < 7:
        return quoted(dice.choice(STRINGS))
    if kind == 7:
        return quoted(dice.choice(PATHS))
    return dice.choice(STRUCTURES)


def mutate_lines(dice: random.Random, text: str, keys: tuple[str, ...]) -> str:
    """Return a configuration with one to three changed lines: keys and values dropped, repeated, renamed
    and exchanged. `keys` are those of all tables."""
    lines = text.splitlines()
    for _ in range(dice.choice((1, 1, 1, 1, 2, 3))):
        if not lines:
            lines = [""]
        i = dice.randrange(len(lines))
        key, sign, value = lines[i].partition(" = ")
        change = dice.randrange(14)
        if change < 5 and sign:
            lines[i] = f"{key} = {any_value(dice)}"
        elif (
            change == 5
            and sign
            and re.search(r"(file|netlist|record|network|trips|nodes|data|mesh)$", key)
        ):
            lines[i] = f"{key} = {quoted(dice.choice(PATHS))}"
        elif change == 6 and sign and '"' in value:
            lines[i] = (
                f"{key} = {value.replace(chr(34), chr(34) + dice.choice(('9', '-', 'x', '../')), 1)}"
            )
        elif change == 7:
            lines.insert(i + 1, f"{dice.choice(keys)} = {any_value(dice)}")
        elif change == 8:
            lines.insert(i, f"{dice.choice(ODD_KEYS)} = {any_value(dice)}")
        elif change == 9 and sign:
            lines[i] = f"{dice.choice((*keys, *ODD_KEYS))} = {value}"
        elif change == 10:
            del lines[i]
        elif change == 11:
            lines.insert(dice.randrange(len(lines) + 1), lines[i])
        elif change == 12:
            j = dice.randrange(len(lines))
            lines[i], lines[j] = lines[j], lines[i]
        else:
            lines.insert(i, dice.choice(LINES))
    return "\n".join(lines) + "\n"


TOKENS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1e999", b"1e308", b"-1e308", b"1e-320", b"0", b"-0", b"-1", b"1e400", b"1_0",
    b"0e999", b"9" * 400, b"1" * 10, b"1000000000", b"2147483648", b"9223372036854775808", b"0x10", b"", b" ", b",",
    b",,", b";", b"\t", b"\n", b"\n\n", b"\r", b"\r\n", b'"', b'"a\nb"', b"'", b"#", b"~", b"*", b"<", b">", b":", b"=",
    b"(", b")", b"[", b"]", b"[1]", b"[m]", b"1\xb2", b"\xb2", "²".encode(), "٣".encode(), "µ".encode(), b"\x00",
    b"\xff", b"\xff\xfe", b"\xef\xbb\xbf", b"\x0b", b"\x0c", b"\x1c", b"\x85", "\u2028".encode(), b"\x1b[31m", b"M",
    b"1MEG", b"1F", b"IC=", b"R=", b"PWL(", b"PULSE(0 5 0 1n 1n 5u 10u)", b"SIN(0 1e308 1e308)", b"D9 a 0", b"C9 a a 1",
    b"Origin", b"Origin 1\n", b"<END OF METADATA>", b"<NUMBER OF ZONES> 999999999", b"<NUMBER OF NODES> 999999999",
    b"<TOTAL OD FLOW> 0e999", b"*INCLUDE, INPUT=/etc/passwd", b"$Nodes", b"$EndNodes", b"*** ", b"NPTS= 999999999, DT= 1e308 SEC",
    b"units g ", b" " * 3000, b"a" * 3000, b"1," * 3000, b"\xf0\x9f\x98\x80",
)  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


def mutate_bytes(dice: random.Random, content: bytes) -> bytes:
    """Return bytes with one to three changes: truncated, flipped, removed, repeated, replaced, inserted,
    numbers exchanged, other line ends and encodings."""
    data = bytearray(content)
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        at = dice.randrange(len(data) + 1)
        length = dice.choice((1, 1, 2, 4, 8, 20, 200))
        change = dice.randrange(15)
        if change == 0:
            del data[at:]
        elif change == 1 and at < len(data):
            data[at] ^= 1 << dice.randrange(8)
        elif change == 2:
            data[at : at + length] = dice.randbytes(length)
        elif change == 3:
            del data[at : at + length]
        elif change == 4:
            data[at:at] = dice.randbytes(length)
        elif change == 5:
            data[at:at] = data[at : at + length] * dice.choice((1, 2, 50))
        elif change == 6:
            data[at:at] = dice.choice(TOKENS)
        elif change in (7, 8, 9):
            found = list(_NUMBER.finditer(bytes(data)))
            if found:
                number = dice.choice(found)
                data[number.start() : number.end()] = dice.choice(TOKENS)
        elif change == 10:
            lines = bytes(data).split(b"\n")
            i, j = dice.randrange(len(lines)), dice.randrange(len(lines))
            if dice.random() < 0.5:
                lines[i], lines[j] = lines[j], lines[i]
            else:
                lines[i] = lines[j]
            data = bytearray(b"\n".join(lines))
        elif change == 11:
            cells = re.split(rb"([,\s]+)", bytes(data))
            cells[dice.randrange(len(cells))] = dice.choice(TOKENS)
            data = bytearray(b"".join(cells))
        elif change == 12:
            data = bytearray(
                dice.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"\n", b"\x00", b"#", b"PK\x03\x04"))
                + data
            )
        elif change == 13:
            ends = dice.choice((b"\r\n", b"\r", b"\n\n", b"\x0c", b" \n", b""))
            data = bytearray(bytes(data).replace(b"\n", ends))
        elif change == 14 and dice.random() < 0.3:
            encoding = dice.choice(("utf-16", "utf-32", "utf-16-be", "utf-7", "cp037"))
            data = bytearray(bytes(data).decode("latin-1").encode(encoding))
        elif at + 8 <= len(data):
            extreme = dice.choice((-1, 2**31 - 1, 2**31, 2**40, 2**62, -(2**63), 0)).to_bytes(
                8, "little", signed=True
            )
            data[at : at + 8] = extreme
    return bytes(data)
