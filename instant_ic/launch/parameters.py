"""Checks the parameters of a launch description's nodes without starting them (it imports their modules)."""

from __future__ import annotations

from collections.abc import Sequence

from instant_ic.launch.description import NodeSpec


def check_parameters(nodes: Sequence[NodeSpec]) -> list[str]:
    """What the nodes would refuse: unknown parameters, wrong types, values out of range; each in words.

    Programs given by path (``exec: my_node.py``) are not looked into.
    """
    from instant_ic.bag.replay import ReplayError, find_node_class
    from instant_ic.bus.params import ParameterError
    from instant_ic.bus.process import argument_parser, load_config, parse_remaps

    problems: list[str] = []
    for spec in nodes:
        if spec.exec.endswith(".py"):
            continue
        where = f"{spec.file}:{spec.line}: node {spec.name}"
        try:
            node_class = find_node_class(spec.exec)
            words = spec.command[spec.command.index("--name") :]
            args = argument_parser(node_class).parse_args(words)
            parse_remaps(args.remap)
            load_config(node_class, args.name, args.params_file, args.param)
        except (ParameterError, ReplayError) as error:
            problems.append(f"{where}: {error}")
        except SystemExit:  # argparse has told what is wrong with the arguments
            problems.append(f"{where}: wrong arguments")
    return problems
