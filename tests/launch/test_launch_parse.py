from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.bus.params import parse_override
from instant_ic.launch import LaunchFileError, read_arguments, read_launch_file
from instant_ic.launch.substitutions import Context, SubstitutionError, substitute, truth
from instant_ic.launch.values import as_yaml


@pytest.fixture
def context(tmp_path: Path) -> Context:
    return Context(
        tmp_path / "a.yaml", tmp_path / "run", {"world": "hall", "on": "true", "evil": "x == x or"}, {"HOME": "/h"}
    )


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
        ("$(env HOME)", "/h"),
        ("$(env NOPE over there)", "over there"),
        ("$(env NOPE $(var world))", "hall"),
        ("$(eval world == 'hall')", "true"),
        ("$(eval '$(var world)' != \"hall\")", "false"),
        ("$(eval not ($(var world) == cave) and on)", "true"),
        ("$(eval on and not on or world == hall)", "true"),
        # What a variable holds is an operand, never a piece of the expression.
        ("$(eval $(var evil) == '')", "false"),
    ],
)
def test_substitution(context: Context, text: str, expected: str) -> None:
    assert substitute(text, context) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("$(var nope)", "unknown variable 'nope' (in scope: evil, on, world)"),
        ("$(var world", "unclosed"),
        ("$(env NOPE)", "NOPE is not set"),
        ("$(shell rm)", "unknown substitution $(shell ...)"),
        ("$(config no_such_file.yaml)", "no_such_file.yaml does not exist"),
        ("$(eval __import__('os'))", "must be true or false, got '__import__'"),
        ("$(eval world ==)", "an operand is missing"),
        ("$(eval (on)", "unclosed"),
        ("$(eval world)", "must be true or false, got 'hall'"),
    ],
)
def test_substitution_error(context: Context, text: str, message: str) -> None:
    with pytest.raises(SubstitutionError) as caught:
        substitute(text, context)
    assert message in str(caught.value)


@given(st.text())
def test_any_text_is_substituted_or_refused_with_words(text: str) -> None:
    context = Context(Path("a.yaml"), Path("run"), {"a": "b"}, {})
    try:
        result = substitute(text, context)
    except SubstitutionError as error:
        assert str(error)
    else:
        assert "$(" in text or result == text


@given(st.text(max_size=20), st.text(max_size=20))
def test_eval_compares_any_two_values_as_text(left: str, right: str) -> None:
    context = Context(Path("a.yaml"), Path("run"), {"left": left, "right": right}, {})
    assert truth(substitute("$(eval $(var left) == $(var right))", context)) == (left == right)


def test_every_key(tmp_path: Path, program: Path) -> None:
    write(tmp_path, "talker:\n  ros__parameters:\n    rate: 3\n", "params.yaml")
    file = write(
        tmp_path,
        """
launch:
- arg: {name: port, default: "80", description: where}
- arg: {name: extra}
- let: {name: url, value: "http://host:$(var port)"}
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
    args: --log-level "very loud"
    respawn: true
    respawn_delay: 2.5
    required: $(eval extra == yes)
- node: {exec: talker.py, name: t2, if: $(eval extra == no)}
- node: {exec: talker.py, name: t3, unless: $(eval extra == no)}
""",
    )
    description = read_launch_file(file, {"extra": "yes"})
    assert [node.name for node in description.nodes] == ["t1", "t3"]
    node = description.nodes[0]
    assert node.command[1:] == (
        str(program),
        *("--name", "t1", "--params-file", str(tmp_path / "params.yaml")),
        *("-p", "port:=80", "-p", "label:='80'", "-p", "quoted:='12'", "-p", "url:=http://host:80"),
        *("-p", "nothing:=''", "-p", "list:=[1, '80']", "-r", "/scan:=/other", "--log-level", "very loud"),
    )
    assert node.env == {"OMP_NUM_THREADS": "1"}
    assert (node.respawn, node.respawn_delay_s, node.required) == (True, 2.5, True)
    assert [argument.name for argument in read_arguments(file)] == ["port", "extra"]


def test_group_has_its_own_scope_and_namespace(tmp_path: Path, program: Path) -> None:
    file = write(
        tmp_path,
        """
launch:
- let: {name: x, value: outer}
- group:
    namespace: left
    launch:
    - let: {name: x, value: inner}
    - node: {exec: talker.py, name: first, param: [{name: x, value: $(var x)}]}
- group:
  - node: {exec: talker.py, param: [{name: x, value: $(var x)}]}
- group: {if: "false", launch: [{node: {exec: talker.py, name: never}}]}
""",
    )
    nodes = read_launch_file(file).nodes
    assert [node.name for node in nodes] == ["first", "talker"]
    assert [node.namespace for node in nodes] == ["left", ""]
    assert "x:=inner" in nodes[0].command and "x:=outer" in nodes[1].command
    assert nodes[0].command[nodes[0].command.index("--namespace") + 1] == "left"


def test_include_passes_only_what_is_given(tmp_path: Path, program: Path) -> None:
    write(
        tmp_path,
        """
launch:
- arg: {name: who, default: nobody}
- arg: {name: rate, default: 1}
- node: {exec: talker.py, name: $(var who), param: [{name: rate, value: $(var rate)}]}
""",
        "part.yaml",
    )
    file = write(
        tmp_path,
        """
launch:
- arg: {name: rate, default: 5}
- include: {file: part.yaml, arg: [{name: who, value: bob}]}
- include: {file: $(dirname)/part.yaml, let: [{name: who, value: eve}, {name: rate, value: $(var rate)}]}
- include: {file: part.yaml, if: "no"}
""".replace('"no"', '"false"'),
    )
    nodes = read_launch_file(file).nodes
    assert [(node.name, node.command[-1]) for node in nodes] == [("bob", "rate:=1"), ("eve", "rate:=5")]


def test_all_mistakes_at_once_with_their_lines(tmp_path: Path, program: Path) -> None:
    write(tmp_path, "talker:\n  rate: 3\n", "flat.yaml")
    file = write(
        tmp_path,
        """launch:
- arg: {name: must}
- node: {exec: warp_drive}
- node:
    exec: talker.py
    respawm: true
    respawn_delay: soon
    param:
    - from: nowhere.yaml
    - from: flat.yaml
    - {name: a, value: x, type: int}
    - {name: b}
- node: {exec: talker.py, name: n13, if: maybe}
- nodes: {exec: talker.py}
- node: {name: nameless}
- include: {file: gone.yaml}
- node: {exec: talker.py, name: n17, param: [{name: v, value: $(var missing)}]}
- node: talker
""",
    )
    found = problems_of(file, wrong="1")
    by_line = {int(text.split(":")[0]): text for text in found}
    assert any("there is no argument 'wrong'" in text for text in found)
    assert "argument 'must' has no default: give must:=VALUE" in by_line[2]
    assert "unknown exec 'warp_drive'" in by_line[3]
    assert "unknown key 'respawm'" in by_line[6]
    assert "expected a number, got 'soon'" in by_line[7]
    assert "nowhere.yaml does not exist" in by_line[9]
    assert any("section 'talker' has no ros__parameters" in text for text in found)
    assert "'x' is not of type int" in by_line[11]
    assert "a parameter needs name and value" in by_line[12]
    assert "must be true or false, got 'maybe'" in by_line[13]
    assert "unknown key 'nodes'" in by_line[14]
    assert "'exec' is missing" in by_line[15]
    assert "gone.yaml does not exist" in by_line[16]
    assert "unknown variable 'missing'" in by_line[17]
    assert "expected keys and values, got a single value" in by_line[18]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("launch: [\n", "2: not YAML"),
        ("", "1: the file is empty"),
        ("nodes: []\n", "1: unknown key 'nodes'"),
        ("launch:\n- node: {exec: talker.py}\n- node: {exec: talker.py}\n", "3: a node named 'talker'"),
        ("launch:\n- node: {exec: talker.py, name: a-b}\n", "2: node name 'a-b' is not legal"),
        ("launch:\n- arg: {name: a, default: 1}\n- arg: {name: a, default: 2}\n", "3: argument 'a' is declared a"),
        ("launch:\n- let: {name: a, name: b, value: 1}\n", "2: 'name' stands here a second time"),
        ("launch:\n- include: {file: stack.yaml}\n", "2: files include each other"),
        ("launch:\n- include: {file: $(launch-file), arg: [{name: q, value: 1}]}\n", "2: stack.yaml has no argument"),
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
    word = f"key:={as_yaml(value)}"
    assert "\n" not in word
    assert parse_override(word)[1].value == value


def test_problem_is_told_as_file_and_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path, "launch:\n- node: {exec: warp}\n")
    with pytest.raises(LaunchFileError, match=r"^stack\.yaml:2: unknown exec 'warp'"):
        read_launch_file(file)
