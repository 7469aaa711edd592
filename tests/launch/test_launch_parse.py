"""Launch files: what is read from them, and the errors with file and line."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.config.params import parse_override
from instant_ic.config.yaml_text import one_line
from instant_ic.launch import LaunchFileError, read_arguments, read_launch_file
from instant_ic.launch.substitutions import SubstitutionError, substitute, truth

VARIABLES = {"world": "hall", "on": "true", "evil": "x == x or", "port": "80"}


@pytest.fixture
def program(tmp_path: Path) -> Path:
    file = tmp_path / "talker.py"
    file.write_text("pass\n")
    return file


def write(folder: Path, text: str, name: str = "stack.yaml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def problems_of(file: Path, **arguments: str) -> list[str]:
    with pytest.raises(LaunchFileError) as caught:
        read_launch_file(file, arguments)
    return [f"{problem.line}: {problem.text}" for problem in caught.value.problems]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("plain", "plain"),
        ("a-$(var world)-b", "a-hall-b"),
        ("$(eval world == 'hall')", "true"),
        ('$(eval "a" != world and (on or not on))', "true"),
        ("$(eval on and not on or world == 'hall')", "true"),
        ("$(eval on == 'true' and on == True)", "true"),
        ("$(eval port == 80)", "true"),
        ("$(eval evil == '' or evil == 'x')", "false"),  # a variable is one operand
        ("$(eval world)", "hall"),
    ],
)
def test_substitution(text: str, expected: str) -> None:
    assert substitute(text, VARIABLES, Path("run")) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("$(var nope)", "unknown variable 'nope' (in scope: evil, on, port, world)"),
        ("$(var world", "unclosed"),
        ("$(command rm)", "unknown substitution $(command ...); supported: $(var NAME)"),
        ("$(config no_such_file.yaml)", "no_such_file.yaml does not exist"),
        ("$(eval (on)", "unclosed"),
        ("$(eval world ==)", "invalid syntax"),
        ("$(eval '$(var world)' == 'hall' and $(var on))", "name variables without $(var ...)"),
        ("$(eval wrld == 'hall')", "'wrld' is not defined"),
        ("$(eval world and on)", "must be true or false, got 'hall'"),
        ("$(eval world < 3)", "not supported between"),
        ("$(eval )", "empty"),
        # Nothing is executed.
        ("$(eval __import__('os').system('rm'))", "not defined"),
        ("$(eval world.__class__ == '')", "__class__"),
        ("$(eval 'a' * 9999999999 == '')", "not"),
    ],
)
def test_substitution_error(text: str, message: str) -> None:
    with pytest.raises(SubstitutionError) as caught:
        substitute(text, VARIABLES, Path("run"))
    assert message in str(caught.value)


@given(st.text(max_size=20), st.text(max_size=20))
def test_eval_compares_any_two_values_as_text(left: str, right: str) -> None:
    result = substitute("$(eval left == right)", {"left": left, "right": right}, Path("run"))
    assert truth(result) == (left == right)


def test_every_key(tmp_path: Path, program: Path) -> None:
    write(tmp_path, "talker:\n  ros__parameters:\n    rate: 3\n", "params.yaml")
    file = write(
        tmp_path,
        """
launch:
- arg: {name: port, default: "80", description: where}
- arg: {name: extra}
- let: {name: url, value: "http://host:$(var port)"}
- let: {name: url, value: other, if: "false"}
- set_parameters_from_file: {filename: params.yaml}
- node:
    exec: talker.py
    name: t1
    param:
    - from: params.yaml
    - {name: port, value: $(var port)}
    - {name: label, value: $(var port), type: str}
    - {name: quoted, value: "12"}
    - {name: url, value: $(var url)}
    - {name: nothing, value: ""}
    - {name: list, value: [1, $(var port)]}
    - {name: left_out, value: 1, if: "false"}
    remap:
    - {from: /scan, to: /other}
    env:
    - {name: OMP_NUM_THREADS, value: 1}
    respawn: true
    respawn_delay: 2.5
    hang_timeout: 3
    required: $(eval extra == 'yes')
- node: {exec: talker.py, name: t2, if: $(eval extra == 'no')}
- node: {exec: talker.py, name: t3, unless: $(eval extra == 'no')}
""",
    )
    description = read_launch_file(file, {"extra": "yes"})
    assert [node.name for node in description.nodes] == ["t1", "t3"]
    node = description.nodes[0]
    params = ("--params-file", str(tmp_path / "params.yaml"))
    assert node.command[1:] == (
        *(str(program), "--name", "t1", *params, *params),
        *("-p", "port:=80", "-p", "label:='80'", "-p", "quoted:='12'", "-p", "url:=http://host:80"),
        *("-p", "nothing:=''", "-p", "list:=[1, 80]", "-r", "/scan:=/other"),
    )
    assert node.env == {"OMP_NUM_THREADS": "1"} and node.places["port:=80"].endswith("stack.yaml:13")
    assert (node.respawn, node.respawn_delay_s, node.required, node.hang_timeout_s) == (True, 2.5, True, 3.0)
    assert [(a.name, a.default, a.description) for a in read_arguments(file)] == [
        ("port", "80", "where"),
        ("extra", None, ""),
    ]


def test_include_passes_only_what_is_given(tmp_path: Path, program: Path) -> None:
    part = """
launch:
- arg: {name: who, default: nobody}
- arg: {name: rate, default: 1}
- node: {exec: talker.py, name: $(var who), param: [{name: rate, value: $(var rate)}]}
"""
    write(tmp_path, part, "part.yaml")
    file = write(
        tmp_path,
        """
launch:
- arg: {name: rate, default: 5}
- include: {file: part.yaml, arg: [{name: who, value: bob}]}
- include: {file: part.yaml, arg: [{name: who, value: eve}, {name: rate, value: $(var rate)}]}
- include: {file: part.yaml, if: "false"}
""",
    )
    nodes = read_launch_file(file).nodes
    assert [(node.name, node.command[-1]) for node in nodes] == [("bob", "rate:=1"), ("eve", "rate:=5")]


def test_the_mistakes_of_all_entries_at_once_with_their_lines(tmp_path: Path, program: Path) -> None:
    write(tmp_path, "launch:\n- arg: {name: port, type: int, default: 1}\n", "part.yaml")
    file = write(
        tmp_path,
        """launch:
- arg: {name: must}
- node: {exec: warp_drive}
- node: {exec: talker.py, respawm: true}
- node: {exec: talker.py, respawn_delay: soon}
- node: {exec: talker.py, param: [{from: nowhere.yaml}]}
- node: {exec: talker.py}
- node: {exec: talker.py, param: [{name: a, value: x, type: int}]}
- node: {exec: talker.py, param: [{name: b}]}
- node: {exec: talker.py, if: maybe}
- nodes: {exec: talker.py}
- node: {name: nameless}
- include: {file: gone.yaml}
- include: {file: part.yaml, arg: [{name: prt, value: 1}]}
- include: {file: part.yaml, arg: [{name: port, value: high}]}
- node: {exec: talker.py, param: [{name: v, value: $(var missing)}]}
- node: talker
- timer: {period: 2.0, launch: []}
""",
    )
    by_line = dict(text.split(": ", 1) for text in problems_of(file, wrong="1") if "'port'" not in text)
    assert by_line.pop("1") == "there is no argument 'wrong' (arguments: must)"
    expected = {
        "2": "argument 'must' has no default: give must:=VALUE",
        "3": "unknown exec 'warp_drive' (nodes: arbiter",
        "4": "unknown key 'respawm' (supported: ",
        "5": "expected a number of seconds >= 0, got 'soon'",
        "6": "nowhere.yaml does not exist",
        "8": "'x' is not of type int",
        "9": "a parameter needs name and value",
        "10": "must be true or false, got 'maybe'",
        "11": "unknown key 'nodes' (supported: arg, group, include, let, node, set_parameters_from_file)",
        "12": "'exec' is missing",
        "13": "gone.yaml does not exist",
        "14": "part.yaml has no argument 'prt'",
        "16": "unknown variable 'missing'",
        "17": "expected keys and values, got a single value",
        "18": "unknown key 'timer'",
    }
    for line, text in expected.items():
        assert text in by_line[line]
    with pytest.raises(LaunchFileError, match=r"part\.yaml:2: argument 'port' must be of type int \(got 'high'\)"):
        read_launch_file(file, {})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("launch: [\n", "2: not YAML"),
        ("launch: " + 2000 * "[" + 2000 * "]", "1: not YAML"),
        ("launch:\n- include: {file: " + 300 * "x" + ".yaml}\n", "x.yaml does not exist"),
        ("launch:\n- node: {exec: talker.py, param: [{from: " + 300 * "x" + "}]}\n", "x does not exist"),
        ("launch:\n- node: {exec: " + 300 * "x" + ".py}\n", "does not exist beside the launch file"),
        ("launch:\n- let: {name: a, value: $(config " + 300 * "x" + ")}\n", "does not exist"),
        ('launch:\n- node: {exec: talker.py, param: [{name: a, value: [!!int "_"]}]}\n', "2: not YAML: string index"),
        ("", "1: 'launch' is missing"),
        ("nodes: []\n", "1: unknown key 'nodes'"),
        ("launch:\n- node: {exec: talker.py}\n- node: {exec: talker.py}\n", "3: a node named 'talker'"),
        ("launch:\n- node: {exec: talker.py, name: a-b}\n", "2: node name 'a-b' is not legal"),
        ("launch:\n- arg: {name: a, default: 1}\n- arg: {name: a, default: 2}\n", "3: argument 'a' is declared twice"),
        ("launch:\n- arg: {name: a, type: angle, default: 1}\n", "2: unknown type 'angle' (types: str, int, float,"),
        ("launch:\n- let: {name: a, name: b, value: 1}\n", "2: 'name' is given twice"),
        ("launch:\n- include: {file: stack.yaml}\n", "2: files include each other"),
    ],
)
def test_mistake(tmp_path: Path, program: Path, text: str, expected: str) -> None:
    assert any(expected in problem for problem in problems_of(write(tmp_path, text)))


@given(
    st.one_of(
        st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"])),
        st.integers(),
        st.booleans(),
        st.floats(allow_nan=False),
        st.lists(st.integers()),
    )
)
def test_a_parameter_arrives_as_it_was_written(value: object) -> None:
    word = f"key:={one_line(value)}"
    assert "\n" not in word
    assert parse_override(word)[1].value == value


# -- arguments with types ------------------------------------------------------------------------

TYPED = """launch:
- arg: {name: port, type: int, default: 80}
- arg: {name: rate, type: float, default: 1.5}
- arg: {name: dry, type: bool, default: false}
- arg: {name: bag, type: path, default: ""}
- arg: {name: free, type: int, default: ""}
- node: {exec: talker.py, name: t, param: [{name: bag, value: $(var bag)}]}
- node: {exec: talker.py, name: dry_one, if: $(var dry)}
"""


def test_arguments_have_types(tmp_path: Path, program: Path) -> None:
    file = write(tmp_path, TYPED)
    description = read_launch_file(file, {"port": "81", "rate": "2", "dry": "true", "bag": "~/drive"})
    assert description.nodes[0].command[-1] == f"bag:={Path('~/drive').expanduser()}"
    assert [node.name for node in description.nodes] == ["t", "dry_one"]
    assert read_launch_file(file).nodes[0].command[-1] == "bag:=''"  # an empty default may stay empty
    assert problems_of(file, port="x", rate="quick", dry="maybe", free="y") == [
        "2: argument 'port' must be of type int (got 'x')",
        "3: argument 'rate' must be of type float (got 'quick')",
        "4: argument 'dry' must be of type bool (got 'maybe')",
        "6: argument 'free' must be of type int (got 'y')",
    ]


def test_a_path_of_the_command_line_is_relative_to_the_shells_folder(
    tmp_path: Path, program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    file = write(tmp_path, TYPED)
    monkeypatch.chdir(here)
    assert read_launch_file(file, {"bag": "drive"}).nodes[0].command[-1] == f"bag:={here / 'drive'}"


# -- groups with a run directory -----------------------------------------------------------------


def test_group_with_a_run_directory_and_a_scope_of_its_own(tmp_path: Path, program: Path) -> None:
    file = write(
        tmp_path,
        """launch:
- let: {name: x, value: outer}
- node: {exec: talker.py, name: slam}
- group:
    run_dir: left
    launch:
    - let: {name: x, value: inner}
    - node: {exec: talker.py, name: slam, param: [{name: dev, value: $(run-dir)/$(var x)}]}
    - group: {run_dir: arm, launch: [{node: {exec: talker.py, name: slam}}]}
- group: {if: "false", launch: [{node: {exec: talker.py, name: never}}]}
- node: {exec: talker.py, name: after, param: [{name: dev, value: $(run-dir)/$(var x)}]}
""",
    )
    description = read_launch_file(file, {}, Path("/r"))
    assert [(node.label, node.run_dir) for node in description.nodes] == [
        ("slam", None),
        ("left/slam", Path("/r/left")),
        ("left/arm/slam", Path("/r/left/arm")),
        ("after", None),
    ]
    assert description.nodes[1].command[-1] == "dev:=/r/left/inner"
    assert description.nodes[3].command[-1] == "dev:=/r/outer"
    assert description.run_dirs(Path("/r")) == [Path("/r"), Path("/r/left"), Path("/r/left/arm")]


@pytest.mark.parametrize("name", ["a/b", "..", "", "log", "nodes"])
def test_names_that_a_run_directory_cannot_have(tmp_path: Path, name: str) -> None:
    file = write(tmp_path, f"launch:\n- group: {{run_dir: '{name}', launch: []}}\n")
    assert "give a name of letters" in problems_of(file)[0]


def test_same_name_twice_in_one_run_directory_of_a_group(tmp_path: Path, program: Path) -> None:
    node = "{node: {exec: talker.py}}"
    file = write(tmp_path, f"launch:\n- group: {{run_dir: left, launch: [{node}, {node}]}}\n")
    assert "a node named 'talker' is already started" in problems_of(file)[0]
