"""Text tables as programs of several countries write them: separators, decimal commas, encodings, lines above."""

import csv
import io
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import holds, refusal

from slpi_ros.errors import RecordError
from slpi_ros.io.table_files import load_text
from slpi_ros.io.tables import import_table, read_table

ROWS = ((0.0, 1.5, -2.25), (0.5, 2.0, 3e-3), (1.0, -2.5, 4.0))
ENCODINGS = ("utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-le-bom", "utf-16-be-bom")


@pytest.fixture
def table(tmp_path):
    """Return a function that writes text to a file and returns its path."""

    def write(text: str, encoding: str = "utf-8"):
        path = tmp_path / "table.csv"
        bom = "\ufeff" if encoding.endswith("-bom") else ""
        path.write_bytes((bom + text).encode(encoding.removesuffix("-bom")))
        return path

    return write


def told(separator: str, comma: bool, header: str = "Time (s)|Voltage (V)|Position (µm)", end: str = "\n") -> str:
    lines = [separator.join(map(repr, row)) for row in ROWS]
    text = end.join([header.replace("|", separator), *(line.replace(".", ",") if comma else line for line in lines)])
    return text + end


def is_told(path) -> None:
    record = import_table(path)
    np.testing.assert_array_equal(record.time_ns, [0, 500_000_000, 1_000_000_000])
    np.testing.assert_array_equal(record.voltage["x"], [row[1] for row in ROWS])
    np.testing.assert_allclose(record.displacement["x"], [row[2] * 1e-6 for row in ROWS], rtol=1e-15)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("separator", "comma"),
    [(",", False), (";", False), (";", True), ("\t", False), ("\t", True), ("|", False), ("  ", False), ("   ", True)],
)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_separator_decimal_mark_encoding(table, separator, comma, encoding, end):
    is_told(table(told(separator, comma, end=end), encoding))


TITLES = (
    ["Measurement of stage 7, left"],
    ["sep=;"],
    ["Exported by;;", "Rate;1000;", "", "Samples;4000;"],
    ["Title, first; second", "=====", "12.03.2024 12:00"],
    ["1000", ""],
    ["# made by hand", "", ""],
)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("titles", TITLES)
def test_lines_above_the_header(table, titles, separator):
    text = "\n".join(line.replace(";", separator) for line in titles)
    is_told(table(text + "\n" + told(separator, comma=separator != ",")))


def test_units_in_a_line_of_their_own(table):
    text = told(";", comma=True, header="Time|Voltage|Position")
    is_told(table(text.replace("\n", "\ns;V;µm\n", 1)))
    is_told(table("Title\n" + text.replace("\n", "\n[s];[V];[µm]\n", 1)))
    # Where the unit of a column is not known, it is said; none is assumed.
    message = refusal(RecordError, import_table, table(text.replace("\n", "\ns;V;inch\n", 1)))
    assert holds(message, "'Position [inch]'", "'inch'", "displacement")


def test_lines_are_counted_from_the_top_of_the_file(table):
    for bad, data in (("0;x;1", ("line 6", "'Voltage (V)'", "'x'")), ("0;1", ("line 6", 2, 3))):
        path = table("Title\n\n" + told(";", comma=True).replace("1,0;-2,5;4,0", bad))
        assert holds(refusal(RecordError, import_table, path), path, *data)
    path = table("Title\n" + told(";", comma=True) + "0,75;1;1\n")
    assert holds(refusal(RecordError, import_table, path), path, "line 6", "'Time (s)'", 0.75)


def test_decimal_comma_in_cells_of_a_table_with_holes(table):
    path = table("Time;Voltage;Position;Note\n0,5;1,5;;a, b\n0,75;;-2,5;1.5\n1;;1,25;\n")
    record = import_table(path)
    np.testing.assert_array_equal(record.time_ns, [500_000_000, 750_000_000, 1_000_000_000])
    np.testing.assert_array_equal(record.voltage["x"], [1.5, np.nan, np.nan])
    np.testing.assert_allclose(record.displacement["x"], [np.nan, -2.5e-6, 1.25e-6])


@pytest.mark.parametrize("row", ["1,000;0.5;2", "1;0.5;2,5", "1,5;1;0.5"])
def test_decimal_commas_and_points_in_one_table_are_refused(table, row):
    """In 1,000;0.5 the comma may stand for thousands: a guess would be wrong by that."""
    for rest in ("2,5;1;2", "2,5;;"):
        message = refusal(RecordError, import_table, table(f"Time;Voltage;Position\n0;1;2\n{row}\n{rest}\n"))
        # Each cell alone is a number: no column is to blame.
        assert holds(message, "line 3") and not holds(message, "column")
    message = refusal(RecordError, import_table, table("Time;Voltage;Position\n0;1;2\n1;1.000,5;2\n"))
    assert holds(message, "line 3", "'Voltage'", "'1.000,5'")


def test_decimal_comma_needs_another_separator(table):
    path = table("time_s,voltage_V,displacement_um\n0,5,1,5,2,5\n1,5,1,5,2,5\n")
    assert holds(refusal(RecordError, import_table, path), path, "line 2", 6, 3)


@pytest.mark.parametrize("text", ["A title\nand another\n", "only!bars\n1!2\n3!4\n", "names\n1\n2\n"])
def test_no_header_is_told_in_one_line(table, text):
    path = table(text)
    message = refusal(RecordError, import_table, path)
    # An example of a header is the remedy; no line is to blame.
    assert holds(message, path, "time_s,x_V") and not re.search(r"line \d", message)


def test_a_bad_line_never_becomes_the_header(table):
    path = table("time_s,voltage_V,displacement_um\n0,1,2\n1,1,2\nerr,err,err\n2,1,2\n3,1,2\n")
    assert holds(refusal(RecordError, import_table, path), path, "line 4", "'time_s'", "'err'")


def test_names_cannot_spoil_a_terminal(table):
    path = table("time_s,voltage_V,x\033[31m_inch\n0,1,2\n1,1,2\n")
    message = refusal(RecordError, import_table, path, displacement=["x?[31m_inch"])
    assert holds(message, "'x?[31m_inch'") and message.isprintable()


def test_command_tables_too(table):
    t, columns = read_table(table("time_s;x_V\r\n0;1,5\r\n0,5;2,5\r\n", "utf-16"), "V")
    assert (t.tolist(), columns["x"].tolist()) == ([0, 0.5], [1.5, 2.5])


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z", "N")), min_size=1)


@given(
    st.lists(NAMES.filter(lambda name: name.strip() == name), min_size=2, max_size=4, unique=True),
    st.sampled_from(",;\t"),
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=2, max_size=5),
)
def test_what_python_writes_is_read(tmp_path_factory, names, separator, values):
    """Quoted names may hold any separator; the csv module is the oracle."""
    names = [f"n{name}n" for name in names]
    text = io.StringIO()
    csv.writer(text, delimiter=separator, quoting=csv.QUOTE_ALL).writerows([names, *([v] * len(names) for v in values)])
    path = tmp_path_factory.getbasetemp() / "written.csv"
    path.write_bytes(text.getvalue().encode())
    read = load_text(path)
    assert read.columns == tuple(names)
    for column in read.read(names).values():
        assert column.tolist() == values


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(tmp_path_factory, junk):
    path = tmp_path_factory.getbasetemp() / "junk.csv"
    path.write_bytes(junk)
    with pytest.raises(RecordError):
        import_table(path)


@pytest.mark.parametrize("digits", range(0, 17, 2))
def test_numbers_are_read_to_their_last_digit(tmp_path, digits):
    texts = [f"{value:.{digits}f}" for value in np.random.default_rng(digits).normal(0.0, 1e3, 2000).tolist()]
    path = tmp_path / "table.csv"
    for separator, mark in ((",", "."), (";", ",")):
        rows = (f"{k}{separator}{text.replace('.', mark)}\n" for k, text in enumerate(texts))
        path.write_text(f"a{separator}b\n{''.join(rows)}")
        assert load_text(path).read(["b"])["b"].tolist() == [float(text) for text in texts]
