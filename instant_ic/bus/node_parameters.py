"""Parameters of a running node: their present values, and changes of live ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from instant_ic.bus.callbacks import NodeError
from instant_ic.bus.node_interface import NodeInterface
from instant_ic.config import params
from instant_ic.config.parameter_info import ParameterInfo, is_live, parameter_infos, plain


class NodeParameters:
    """The parameters of one node."""

    def __init__(self, node: NodeInterface) -> None:
        self._node = node

    def infos(self) -> list[ParameterInfo]:
        """Return all parameters with their present values. Any thread may call this."""
        node = self._node
        infos = parameter_infos(type(node.config), node.config, node.live_parameters)
        own = {info.name for info in infos}
        common = parameter_infos(params.ProcessParameters, self._process)
        return infos + [info for info in common if info.name not in own]

    def set(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Change live parameters together, or none, on the node's thread.

        Returns:
            The parameters whose value has changed.

        Raises:
            ParameterError: a value is refused, or its parameter cannot be changed while the node runs.
        """
        node = self._node
        own = {field.name for field in dataclasses.fields(type(node.config))}
        flat = params.flatten(values)
        shared = ("use_sim_time", "nice")
        common: dict[str, Any] = {key: flat.pop(key) for key in shared if key in flat and key not in own}
        params.change(self._process, common, lambda key: False, node.node_name)
        config, different = params.change(
            node.config, flat, lambda key: is_live(key, node.live_parameters), node.node_name
        )
        if not different:
            return {}
        try:
            node.reconfigure(config)
        except (ValueError, NodeError) as error:
            raise params.ParameterError(f"{node.node_name}: {error}") from error
        different = {key: plain(value) for key, value in different.items()}
        node.log.info("parameters changed: %s", ", ".join(f"{key} = {value}" for key, value in different.items()))
        node.on_registry_change()
        return different

    @property
    def _process(self) -> params.ProcessParameters:
        return params.ProcessParameters(self._node.use_sim_time, self._node.nice)
