"""Checks that a Zenoh configuration accepts only authenticated hosts."""

from __future__ import annotations

import json
import re
from typing import Any

from instant_ic.bus import ERROR, OK, WARN
from instant_ic.util.web_access import is_loopback

_ENDPOINT = re.compile(r"(?P<link>\w+)/(\[(?P<ipv6>[^\]]+)\]|(?P<host>[^:\[\]/]+)):\d+(\?[^#]*)?\Z")
_TLS_LINKS = ("tls", "quic")
_LOOPBACK_LINKS = ("tcp", *_TLS_LINKS)


def command_security(config: Any, loopback_allowed: bool) -> tuple[int, str]:
    """Diagnose whether a configuration's links may carry operators' commands; ERROR if commands must be refused.

    Args:
        config: the Zenoh configuration.
        loopback_allowed: accept commands without TLS where every link stays within this machine.
    """
    why = insecurity(config)
    if not why:
        return OK, "accepted over TLS, from hosts with a certificate"
    if loopback_allowed:
        beyond = beyond_loopback(config)
        if not beyond:
            return WARN, "accepted without TLS from every program of this machine"
        why = f"insecure_loopback_commands: {beyond}"
    return ERROR, f"only emergency stops are accepted as commands: {why} (docs/fleet.md, TLS and access control)"


def insecurity(config: Any) -> str:
    """Return why a stranger could send over the links of a session; empty if none can.

    Each endpoint must be ``tls/`` or ``quic/`` with certificates on both sides (``enable_mtls``), and discovery must
    not add other links. The router decides itself which hosts it accepts: its file must set ``enable_mtls`` too.
    """
    if why := _other_links(config):
        return why
    listen = _endpoints(config, "listen")
    for endpoint in [*_endpoints(config, "connect"), *listen]:
        if "#" in endpoint:
            return f"{endpoint} has its own settings after the #; set them under transport.link.tls"
        if endpoint.partition("/")[0] not in _TLS_LINKS:
            return f"{endpoint} is not encrypted; use tls/ or quic/"
    tls = _value(config, "transport/link/tls") or {}
    if tls.get("enable_mtls") is not True:
        return "transport.link.tls.enable_mtls is not true"
    if tls.get("verify_name_on_connect") is False:
        return "transport.link.tls.verify_name_on_connect is false"
    names = ["root_ca_certificate", "connect_certificate", "connect_private_key"]
    names += ["listen_certificate", "listen_private_key"] if listen else []
    missing = [name for name in names if not tls.get(name)]
    return f"transport.link.tls has no {', '.join(missing)}" if missing else ""


def beyond_loopback(config: Any) -> str:
    """Return why a link of a session could leave this machine; empty if none can."""
    if why := _other_links(config):
        return why
    for endpoint in [*_endpoints(config, "connect"), *_endpoints(config, "listen")]:
        match = _ENDPOINT.match(endpoint)
        if match is None or match["link"] not in _LOOPBACK_LINKS or not is_loopback(match["ipv6"] or match["host"]):
            return f"{endpoint} is not an address of this machine"
    return ""


def _other_links(config: Any) -> str:
    """Return why links other than the configured endpoints may form."""
    if not _endpoints(config, "connect") and not _endpoints(config, "listen"):
        return "no endpoint is set, so Zenoh discovers other hosts"
    if _value(config, "scouting/multicast/enabled") is not False:
        return "scouting.multicast.enabled is not false"
    if _value(config, "adminspace/permissions/write") is True:
        return "adminspace.permissions.write is true, so others may change this configuration"
    protocols = _value(config, "transport/link/protocols") or ["tcp"]
    gossips = _value(config, "scouting/gossip/enabled") is not False
    if _value(config, "mode") != "client" and gossips and not set(protocols) <= set(_TLS_LINKS):
        return 'a peer connects over any link to hosts that its router reports; set mode: "client"'
    return ""


def _value(config: Any, key: str) -> Any:
    return json.loads(config.get_json(key))


def _endpoints(config: Any, key: str) -> list[str]:
    found = _value(config, f"{key}/endpoints")
    if isinstance(found, dict):  # by mode
        found = found.get(_value(config, "mode") or "peer") or []
    return [str(endpoint) for endpoint in found or []]
