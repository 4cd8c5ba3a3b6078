"""What is said of parameters of which ROS reads something else than is meant."""

import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import started  # noqa: E402
from rclpy.context import Context  # noqa: E402
from refusals import holds  # noqa: E402

from slpi_ros.nodes.parameter_texts import leading_zeros, overridden, remedy  # noqa: E402


@pytest.mark.parametrize(
    ("text", "value"),
    [("010", 8), ("-0123", -83), ("00", 0), ("0", None), ("089", None), ("0.5", None), ("'010'", None)],
)
def test_leading_zeros(tmp_path, text, value):
    file = tmp_path / "given.yaml"
    file.write_text(f"node:\n  ros__parameters:\n    seed: {text}  # a comment\n    rate: 10\n")
    for arguments in (["--ros-args", "-p", f"seed:={text}"], ["--ros-args", "--params-file", str(file)]):
        said = list(leading_zeros(arguments))
        assert len(said) == (value is not None)
        assert all(holds(each, "seed", value) for each in said)


@pytest.mark.parametrize(
    ("text", "quoted"),
    [("[x, y]", "\"['x', 'y']\""), ("[y]", "\"['y']\""), ("no", "\"'no'\""), ("0123", "\"'0123'\"")],
)
@pytest.mark.parametrize("in_file", [False, True])
def test_a_start_that_fails_says_what_to_quote(tmp_path, text, quoted, in_file):
    name = "axes" if "[" in text else "hardware_id"
    file = tmp_path / "given.yaml"
    file.write_text(f"stage_simulator:\n  ros__parameters:\n    {name}: {text}\n")
    given = ["--params-file", str(file)] if in_file else ["-p", f"{name}:={text}"]
    with started("stage_simulator", {}, *given) as node:
        assert node.wait() == 2
        assert node.stderr.splitlines()[-1].endswith(f"quote it: -p {name}:={quoted}")


def test_options_that_are_none_of_ros_are_left_alone():
    assert not list(leading_zeros(["-p", "seed:=010", "--ros-args", "--", "-p", "seed:=010"]))


def test_another_error_is_left_as_it_is():
    split = remedy(["--ros-args", "-p", "axes:=[x,", "y]", "-p", "seed:=1"], "Couldn't parse parameter override rule")
    assert split.endswith("-p axes:=\"['x', 'y']\"")
    assert remedy(["--ros-args", "-p", "top:=[1.0,", "2e3]"], "Couldn't parse").endswith('-p top:="[1.0, 2e3]"')
    assert remedy(["--ros-args", "-p", "seed:=soon"], "seed is of type STRING, expecting INTEGER") == ""


OWN, ALL = "node:\n  ros__parameters:\n    top: 50.0\n", "/**:\n  ros__parameters:\n    top: 100.0\n    low: 1.0\n"
NESTED = "lab:\n  node:\n    ros__parameters:\n      top: 50.0\n"
FREE = "other:\n  ros__parameters:\n    top: 7.0\n"


@pytest.mark.parametrize(
    ("files", "given", "namespace", "used", "told"),
    [
        ([ALL + OWN], None, "", 50.0, False),
        ([OWN + ALL], None, "", 100.0, True),
        ([OWN + FREE], None, "", 50.0, False),
        ([ALL + OWN], 30.0, "", 50.0, True),
        ([OWN + ALL], 30.0, "", 30.0, False),
        ([OWN, ALL], None, "", 100.0, False),
        ([OWN + ALL, OWN], None, "", 100.0, True),
        ([NESTED + ALL], None, "/lab", 100.0, True),
        ([NESTED + ALL], None, "", 100.0, False),
        ([], 30.0, "", 30.0, False),
        (["[broken"], None, "", None, False),
    ],
)
def test_a_block_that_overrides_what_is_meant_is_told(tmp_path, files, given, namespace, used, told):
    arguments = ["--ros-args"]
    for i, content in enumerate(files):
        (tmp_path / f"{i}.yaml").write_text(content)
        arguments += ["--params-file", str(tmp_path / f"{i}.yaml")]
    arguments += ["-p", f"top:={given}"] if given else []
    if used is None:
        assert list(overridden(arguments, _Unmade())) == []
        return
    context = Context()
    rclpy.init(args=arguments, context=context)
    node = rclpy.create_node("node", namespace=namespace, context=context, cli_args=None)
    try:
        assert node._parameter_overrides["top"].value == used
        said = list(overridden(arguments, node))
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert len(said) == told
    assert all(holds(each, "top", used) for each in said)


class _Unmade:
    """A node that ROS refuses to make."""

    def get_fully_qualified_name(self) -> str:
        return "/node"

    def get_name(self) -> str:
        return "node"


def test_both_are_told_at_the_start(tmp_path):
    file = tmp_path / "given.yaml"
    file.write_text(
        "stage_simulator:\n  ros__parameters:\n    voltage_max: 50.0\n    seed: 010\n"
        "/**:\n  ros__parameters:\n    voltage_max: 90.0\n"
    )
    with started("stage_simulator", {}, "--params-file", str(file)) as node:
        while "90" not in node.stderr or "simulated-8" not in node.stderr:
            assert node.process.poll() is None
        assert holds(node.stderr, "voltage_max", "90.0", "50.0", "seed", "octal")
