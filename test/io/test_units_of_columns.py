"""The table of a path that a calibration shall cover."""

import pytest

from slpi_ros.io.desired import read_path


@pytest.mark.parametrize("header", ["x_um,y_nm", "x_m,y_um", "x_nm,y_m,y_um"])
def test_no_axis_is_lost_whose_column_is_in_another_unit(tmp_path, header):
    scales = {"m": 1.0, "um": 1e-6, "nm": 1e-9}
    columns, path = header.split(","), tmp_path / "path.csv"
    rows = [",".join(str(2 * k + row) for k in range(len(columns))) for row in (1, 2)]
    path.write_text(f"time_s,{header}\n0,{rows[0]}\n1,{rows[1]}\n")
    read = read_path(path, ("x", "y"))[1]
    assert list(read) == ["x", "y"]
    for name, values in zip(columns[:2], ([1.0, 2.0], [3.0, 4.0]), strict=True):
        axis, unit = name.split("_")
        assert read[axis] == pytest.approx([scales[unit] * value for value in values])


def test_a_column_beside_those_of_the_axes_is_ignored(tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("time_s,x_m,error_nm\n0,1e-6,3\n1,2e-6,\n")
    assert list(read_path(path, ("x",))[1]) == list(read_path(path)[1]) == ["x"]
