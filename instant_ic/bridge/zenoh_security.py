"""Whether a Zenoh configuration lets only hosts in that prove who they are."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from .web_access import is_loopback

_ADDRESS = re.compile(r"(?P<link>[a-z0-9_.-]+)/(?P<host>\[[^\]]+\]|[^:\[\]]+):\d+\Z")
_TLS_LINKS = ("tls", "quic")
_LOOPBACK_LINKS = ("tcp", *_TLS_LINKS)


def insecurity(config: Any, loopback: bool = False) -> str:
    """Why strangers could send over links of this session; empty where they cannot.

    Each endpoint must be ``tls/`` or ``quic/`` with certificates on both sides (``enable_mtls``), and no other link may
    come about by discovery. The router decides for itself whom it lets in: its file must say ``enable_mtls`` too.

    Args:
        config: of Zenoh.
        loopback: links within this machine will do, whatever they speak: everybody on the machine can then send.
    """
    endpoints = [*_endpoints(config, "connect"), *_endpoints(config, "listen")]
    if not endpoints:
        return "there is no endpoint, so Zenoh looks for others itself: set connect"
    if _value(config, "scouting/multicast/enabled") is not False:
        return "scouting.multicast is enabled, so links of any kind may come about: disable it"
    mode = _value(config, "mode")
    protocols = _value(config, "transport/link/protocols") or []
    only_tls = bool(protocols) and set(protocols) <= set(_TLS_LINKS)
    if mode != "client" and _value(config, "scouting/gossip/enabled") is not False and not only_tls:
        return 'as a peer it links with whom the router tells of: set mode: "client", or transport.link.protocols: ["tls"]'
    if loopback:
        return next((f"{endpoint} is not an address of this machine" for endpoint in endpoints if not _is_local(endpoint)), "")
    for endpoint in endpoints:
        if "#" in endpoint:
            return f"{endpoint} has settings of its own (#...): put them under transport.link.tls"
        if endpoint.partition("/")[0] not in _TLS_LINKS:
            return f"{endpoint} is not encrypted: use tls/ or quic/"
    tls = _value(config, "transport/link/tls") or {}
    if tls.get("enable_mtls") is not True:
        return "transport.link.tls.enable_mtls is not true"
    needed = [("root_ca_certificate",), ("connect_certificate",), ("connect_private_key",)]
    if _endpoints_list(config, "listen"):
        needed += [("listen_certificate",), ("listen_private_key",)]
    for (name,) in needed:
        if not (tls.get(name) or tls.get(f"{name}_base64")):
            return f"transport.link.tls.{name} is missing"
    if tls.get("verify_name_on_connect") is False:
        return "transport.link.tls.verify_name_on_connect is false"
    return ""
