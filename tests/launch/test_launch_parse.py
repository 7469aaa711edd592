from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from instant_ic.config.params import parse_override
from instant_ic.config.yaml_text import one_line
from instant_ic.launch import LaunchFileError, read_arguments, read_launch_file
from instant_ic.launch.substitutions import Context, SubstitutionError, substitute, truth


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
        *("-p", "nothing:=''", "-p", "list:=[1, 80]", "-r", "/scan:=/other", "--log-level", "very loud"),
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
        ("launch: " + 2000 * "[" + 2000 * "]", "1: not YAML"),
        ("launch:\n- include: {file: " + 300 * "x" + ".yaml}\n", "x.yaml does not exist"),
        ("launch:\n- node: {exec: talker.py, param: [{from: " + 300 * "x" + "}]}\n", "x does not exist"),
        ("launch:\n- node: {exec: " + 300 * "x" + ".py}\n", "does not exist beside the launch file"),
        ("launch:\n- let: {name: a, value: $(config " + 300 * "x" + ")}\n", "does not exist"),
        (
            'launch:\n- node: {exec: talker.py, param: [{name: a, value: [!!int "_"]}]}\n',
            "2: not YAML: string index out of range",
        ),
        ("", "1: the file is empty"),
        ("nodes: []\n", "1: unknown key 'nodes'"),
        ("launch:\n- node: {exec: talker.py}\n- node: {exec: talker.py}\n", "3: a node named 'talker'"),
        ("launch:\n- node: {exec: talker.py, name: a-b}\n", "2: node name 'a-b' is not legal"),
        ("launch:\n- arg: {name: a, default: 1}\n- arg: {name: a, default: 2}\n", "3: argument 'a' is declared twice"),
        ("launch:\n- let: {name: a, name: b, value: 1}\n", "2: 'name' is given twice"),
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
    word = f"key:={one_line(value)}"
    assert "\n" not in word
    assert parse_override(word)[1].value == value


def test_a_list_of_aliases_to_a_long_text_is_refused_before_it_is_expanded(tmp_path: Path) -> None:
    """11 110 uses of a variable of 100 kB would be 1 GB."""
    lines = [f"      - &a{i} [{', '.join(['$(var long)' if i == 0 else f'*a{i - 1}'] * 10)}]\n" for i in range(4)]
    text = "launch:\n- arg: {name: long, default: " + "x" * 100_000 + "}\n"
    text += "- set_parameter:\n    name: p\n    value:\n" + "".join(lines)
    [problem] = problems_of(write(tmp_path, text))
    assert "6: its texts have more than 131072 characters" in problem


def test_problem_is_told_as_file_and_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path, "launch:\n- node: {exec: warp}\n")
    with pytest.raises(LaunchFileError, match=r"^stack\.yaml:2: unknown exec 'warp'"):
        read_launch_file(file)


# -- arguments with types ------------------------------------------------------------------------

TYPED = """launch:
- arg: {name: port, type: int, default: 80}
- arg: {name: rate, type: float, default: 1.5}
- arg: {name: dry, type: bool, default: false}
- arg: {name: bag, type: path, default: ""}
- arg: {name: mode, default: fast, choices: [fast, slow]}
- arg: {name: ros, default: a, choice: [{value: a}, {value: b}]}
- node: {exec: talker.py, name: t, param: [{name: port, value: $(var port), type: int}]}
- node: {exec: talker.py, name: dry_one, if: $(var dry)}
"""


def test_arguments_have_types_and_choices(tmp_path: Path, program: Path) -> None:
    file = write(tmp_path, TYPED)
    given = {"port": "81", "rate": "2", "dry": "true", "bag": "~/drive", "mode": "slow", "ros": "b"}
    description = read_launch_file(file, given)
    assert description.values["bag"] == str(Path("~/drive").expanduser())
    assert [node.name for node in description.nodes] == ["t", "dry_one"]
    told = {argument.name: (argument.type, argument.choices) for argument in read_arguments(file)}
    assert told["port"] == ("int", ()) and told["mode"] == ("str", ("fast", "slow"))
    assert told["ros"] == ("str", ("a", "b"))
    assert read_launch_file(file).values["bag"] == ""  # an empty default may stay empty


def test_a_path_of_the_command_line_is_the_shells_not_the_files(
    tmp_path: Path, program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    (tmp_path / "there").mkdir()
    file = write(tmp_path / "there", "launch:\n- arg: {name: bag, type: path, default: lies_beside}\n")
    monkeypatch.chdir(here)
    assert read_launch_file(file, {"bag": "drive"}).values["bag"] == str(here / "drive")
    assert read_launch_file(file).values["bag"] == "lies_beside"


def test_wrong_values_of_arguments_are_told_once_each_at_the_arguments_line(tmp_path: Path, program: Path) -> None:
    file = write(tmp_path, TYPED)
    found = problems_of(file, port="x", rate="quick", dry="maybe", mode="medium", ros="c")
    assert found == [
        "2: argument 'port' must be of type int (got 'x')",
        "3: argument 'rate' must be of type float (got 'quick')",
        "4: argument 'dry' must be of type bool (got 'maybe')",
        "6: argument 'mode' must be one of fast, slow (got 'medium')",
        "7: argument 'ros' must be one of a, b (got 'c')",
    ]


def test_arguments_of_an_included_file_are_checked_and_shown(tmp_path: Path, program: Path) -> None:
    inner = "launch:\n- arg: {name: port, type: int, default: 1}\n- arg: {name: speed, type: float, default: 2}\n"
    write(tmp_path, inner, "part.yaml")
    over = write(tmp_path, "launch:\n- include: {file: part.yaml}\n", "over.yaml")
    assert "part.yaml has one: declare it here" in problems_of(over, speed="3")[0]
    file = write(
        tmp_path,
        "launch:\n- arg: {name: far, default: false}\n"
        "- include: {file: part.yaml, arg: [{name: port, value: high}], if: $(var far)}\n",
    )
    with pytest.raises(LaunchFileError, match=r"part\.yaml:2: argument 'port' must be of type int"):
        read_launch_file(file, {"far": "true"})
    assert [argument.name for argument in read_arguments(file, included=True)] == ["speed"]  # whatever its condition
    told = " ".join(problems_of(file, speed="3"))
    assert "there is no argument 'speed' (arguments: far)" in told


def test_type_of_an_argument_that_does_not_exist(tmp_path: Path) -> None:
    file = write(tmp_path, "launch:\n- arg: {name: a, type: angle, default: 1}\n")
    assert problems_of(file) == ["2: unknown type 'angle' (types: str, int, float, bool, path)"]


# -- groups with a run directory -----------------------------------------------------------------


def test_group_with_a_run_directory_of_its_own(tmp_path: Path, program: Path) -> None:
    file = write(
        tmp_path,
        """launch:
- node: {exec: talker.py, name: slam}
- group:
    run_dir: left
    launch:
    - node: {exec: talker.py, name: slam, param: [{name: dev, value: $(run-dir)/dev}]}
    - group: {run_dir: arm, launch: [{node: {exec: talker.py, name: slam}}]}
- node: {exec: talker.py, name: after, param: [{name: dev, value: $(run-dir)/dev}]}
""",
    )
    description = read_launch_file(file, {}, Path("/r"))
    assert [(node.label, node.run_dir) for node in description.nodes] == [
        ("slam", None),
        ("left/slam", Path("/r/left")),
        ("left/arm/slam", Path("/r/left/arm")),
        ("after", None),
    ]
    assert description.nodes[1].command[-1] == "dev:=/r/left/dev"
    assert description.nodes[3].command[-1] == "dev:=/r/dev"
    assert description.run_dirs(Path("/r")) == [Path("/r"), Path("/r/left"), Path("/r/left/arm")]


@pytest.mark.parametrize("name", ["a/b", "..", "", "log", "nodes"])
def test_names_that_a_run_directory_cannot_have(tmp_path: Path, name: str) -> None:
    file = write(tmp_path, f"launch:\n- group: {{run_dir: '{name}', launch: []}}\n")
    assert "give a name of letters" in problems_of(file)[0]


def test_same_name_twice_in_one_run_directory_of_a_group(tmp_path: Path, program: Path) -> None:
    node = "{node: {exec: talker.py}}"
    file = write(tmp_path, f"launch:\n- group: {{run_dir: left, launch: [{node}, {node}]}}\n")
    assert "a node named 'talker' is already started" in problems_of(file)[0]


# -- ROS 2's spelling ----------------------------------------------------------------------------


def test_a_file_as_ros_2_users_write_it(tmp_path: Path, program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME_PATH", "/a")
    monkeypatch.setenv("GONE", "1")
    write(tmp_path, "/**:\n  ros__parameters: {a: 1}\n", "all.yaml")
    file = write(
        tmp_path,
        """
launch:
- arg: {name: "robot", default: "left"}
- set_env: {name: RMW, value: "$(var robot)_rmw"}
- unset_env: {name: GONE}
- append_env: {name: HOME_PATH, value: /b}
- append_env: {name: HOME_PATH, value: /0, prepend: true}
- set_use_sim_time: {value: true}
- set_parameter: {name: nice, value: 3}
- set_parameters_from_file: {filename: all.yaml}
- set_remap: {from: /scan, to: /front/scan}
- group:
  - push_ros_namespace: {namespace: "$(var robot)"}
  - set_env: {name: RMW, value: inner}
  - node:
      pkg: "instant_ic"
      exec: "grid_slam"
      exec_name: slam
      namespace: "front"
      output: log
      emulate_tty: true
      launch-prefix: nice -n 3
      ros_args: "--ros-args --log-level debug"
      respawn: true
      respawn_max_retries: 2
      sigterm_timeout: "3.5"
      param:
      - name: map
        param:
        - {name: resolution_m, value: 0.05}
  - group:
    - push-ros-namespace: {namespace: /absolute}
    - node: {pkg: instant_ic, exec: navigator}
- executable: {cmd: 'echo "two words" end', cwd: /tmp, env: [{name: A, value: "1"}]}
- executable: {cmd: echo}
- executable: {cmd: "echo $HOME | cat", shell: true, name: piped}
- log: {level: INFO, message: "robot $(var robot)"}
- timer:
    period: 2.0
    children:
    - node: {exec: talker.py}
    - timer: {period: 1.5, launch: [{shutdown: {reason: over}}, {log: {message: late}}]}
""",
    )
    description = read_launch_file(file)
    nodes = {node.name: node for node in description.nodes}
    slam = nodes["grid_slam"]
    common = ("-p", "use_sim_time:=true", "-p", "nice:=3", "--params-file", str(tmp_path / "all.yaml"))
    remap = ("-r", "/scan:=/front/scan")
    start = slam.command.index("--name")
    assert slam.command[:3] == ("nice", "-n", "3")
    assert slam.command[start:] == (
        *("--name", "grid_slam", "--namespace", "left/front", *common, *remap),
        *("-p", "map.resolution_m:=0.05", "--log-level", "debug"),
    )
    assert slam.env == {"RMW": "inner", "GONE": None, "HOME_PATH": "/0:/a:/b"}
    assert (slam.to_terminal, slam.respawn_max_retries, slam.sigterm_timeout_s) == (False, 2, 3.5)
    assert nodes["navigator"].namespace == "/absolute"
    assert nodes["navigator"].env["RMW"] == "inner" and nodes["talker"].env["RMW"] == "left_rmw"
    assert nodes["echo"].command == ("echo", "two words", "end") and nodes["echo"].cwd == Path("/tmp")
    assert nodes["echo"].env["A"] == "1" and not nodes["echo"].heartbeat
    assert nodes["echo_2"].command == ("echo",)
    assert nodes["piped"].command == ("/bin/sh", "-c", "echo $HOME | cat")
    assert nodes["talker"].start_delay_s == 2.0 and nodes["echo"].start_delay_s == 0.0
    assert [(said.text, said.delay_s) for said in description.announcements] == [("robot left", 0.0), ("late", 3.5)]
    assert description.shutdown is not None
    assert (description.shutdown.reason, description.shutdown.delay_s) == ("over", 3.5)


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ("node: {pkg: nav2_bringup, exec: talker.py}", "pkg 'nav2_bringup': nodes are those of instant_ic"),
        ("node: {exec: talker.py, shell: true}", "a node is not started by a shell"),
        ("node: {exec: talker.py, output: {stdout: log}}", "expected a single value, got a mapping"),
        ("node: {exec: talker.py, output: tty}", "output must be one of both, screen, log (got 'tty')"),
        ("node: {exec: talker.py, launch-prefix: no_such_tool -x}", "program 'no_such_tool' does not exist"),
        ("node: {exec: talker.py, cwd: /no/such}", "folder /no/such does not exist"),
        ("node: {exec: talker.py, respawn_max_retries: many}", "expected a whole number, got 'many'"),
        (
            "node: {exec: talker.py, param: [{from: s.yaml, allow_substs: true}]}",
            "a parameter file cannot contain substitutions",
        ),
        ("executable: {cmd: no_such_program -v}", "program 'no_such_program' does not exist"),
        ("executable: {cmd: ''}", "cmd is empty"),
        ("executable: {cmd: echo, env: [{name: A=B, value: c}]}", "environment variable 'A=B': a name has no ="),
        ('executable: {cmd: "echo \'open"}', "No closing quotation"),
        ("node_container: {pkg: a}", "'node_container' is not supported here: every node is a process"),
        ("lifecycle_node: {pkg: a}", "'lifecycle_node' is not supported here"),
        ("include: {file: other.launch.py}", "only YAML launch files are read"),
        ("log: {message: $(command whoami)}", "$(command ...) is not supported here: nothing is executed"),
        ("log: {message: $(find-pkg-share nav2)}", "only instant_ic has a share folder here"),
        ("log: {message: $(find-exec no_such_program)}", "program 'no_such_program' is not in PATH"),
        ("timer: {period: soon, launch: []}", "expected a number, got 'soon'"),
        ("group: {if: true}", "'launch' is missing"),
    ],
)
def test_what_ros_2_has_and_we_have_not_is_told_with_the_reason(
    tmp_path: Path, program: Path, action: str, expected: str
) -> None:
    write(tmp_path, "a:\n  ros__parameters: {b: $(var c)}\n", "s.yaml")
    write(tmp_path, "", "other.launch.py")
    file = write(tmp_path, f"launch:\n- {action}\n")
    assert any(expected in problem for problem in problems_of(file)), problems_of(file)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('$(eval \'"$(var world)" == "hall"\')', "true"),  # ROS 2 quotes the whole expression
        ("$(eval '$(var world) == cave')", "false"),
        ("$(eval '$(var on)')", "true"),
        ("$(eval 3 < 10 and 10 >= 10)", "true"),  # numbers, not texts
        ("$(equals $(var world) hall)", "true"),
        ("$(not-equals '$(var world)' '')", "true"),
        ("$(not $(var on))", "false"),
        ("$(and true $(var on))", "true"),
        ("$(or false 0)", "false"),
        ("$(if $(var on) 'far away' near)", "far away"),
        ("$(if false there)", ""),
        ("$(filename)", "a.yaml"),
        ("i=\\$((i+1)) $(var world)", "i=$((i+1)) hall"),  # a shell's own
    ],
)
def test_substitutions_of_ros_2(context: Context, text: str, expected: str) -> None:
    result = substitute(text, context)
    assert Path(result).name == expected if "filename" in text else result == expected


def test_share_folder_holds_launch_and_config(context: Context) -> None:
    share = Path(substitute("$(find-pkg-share instant_ic)", context))
    assert (share / "launch" / "sim.yaml").is_file() and (share / "config" / "slam.yaml").is_file()


def test_anonymous_names_differ(context: Context) -> None:
    names = {substitute("$(anon view)", context) for _ in range(3)}
    assert len(names) == 3 and all(name.startswith("view_") for name in names)


# -- whatever stands in a file -------------------------------------------------------------------

_ACTIONS = (
    *("arg", "let", "node", "executable", "include", "group", "set_env", "unset_env", "append_env", "set_remap"),
    *(
        "push_ros_namespace",
        "set_parameter",
        "set_parameters_from_file",
        "set_use_sim_time",
        "log",
        "timer",
        "shutdown",
    ),
    *("node_container", "nothing"),
)
_KEYS = (
    *("name", "default", "type", "choices", "choice", "value", "exec", "cmd", "param", "from", "to", "remap", "env"),
    *("args", "ros_args", "if", "unless", "file", "arg", "launch", "children", "run_dir", "namespace", "scoped"),
    *("respawn", "respawn_delay", "respawn_max_retries", "hang_timeout", "output", "cwd", "launch-prefix", "period"),
    *("message", "reason", "pkg", "shell", "allow_substs", "filename", "separator", "prepend"),
)
_SCALARS = st.one_of(
    st.sampled_from(["true", "1", "-3", "1.5", "a", "talker.py", "grid_slam", "echo", "", "int", "params.yaml", "~"]),
    st.sampled_from(["$(var a)", "$(eval a == 1)", "$(env HOME)", "$(if true x)", "$(", "'", "$(run-dir)", "\\$(x"]),
    st.none(),
    st.text(max_size=8),
    st.integers(),
    st.booleans(),
)
_BODIES = st.recursive(
    _SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from(_KEYS), inner, max_size=6),
        st.lists(st.dictionaries(st.sampled_from(_ACTIONS), inner, min_size=1, max_size=1), max_size=3),
    ),
    max_leaves=20,
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.dictionaries(st.sampled_from(_ACTIONS), _BODIES, min_size=1, max_size=2), max_size=6))
def test_any_file_is_read_or_refused_with_lines(tmp_path: Path, program: Path, actions: list[object]) -> None:
    write(tmp_path, "a:\n  ros__parameters: {b: 1}\n", "params.yaml")
    file = write(tmp_path, yaml.safe_dump({"launch": actions}, allow_unicode=True))
    lines = len(file.read_text().splitlines()) + 1  # also U+0085 ends a line of YAML
    read_arguments(file)
    try:
        description = read_launch_file(file, {"a": "1"}, tmp_path / "r")
    except LaunchFileError as error:
        assert error.problems and all(problem.text for problem in error.problems)
        assert all(1 <= problem.line <= lines for problem in error.problems if problem.file == file)
    else:
        assert all(node.command for node in description.nodes)
