"""``ic keys``: keys of this host and of the hosts linked with it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import group, verb
from instant_ic.cli.errors import UserError

if TYPE_CHECKING:
    from instant_ic.bridge.host_keys import KeyStore


def add_parser(subparsers: Any) -> None:
    """Add the command with its verbs."""
    verbs = group(
        subparsers, "keys", "manage keys of the link between robot and station",
        "Create this host's key, and set which other hosts may connect to it (docs/bridge.md).", "ic keys new",
    )  # fmt: skip

    def with_folder(name: str, words: str, run: Any, example: str, description: str) -> Any:
        parser = verb(verbs, name, words, run, f"ic keys {example}", description)
        text = "folder of keys (default: ~/.config/instant_ic/keys)"
        parser.add_argument("--dir", type=Path, metavar="FOLDER", help=text)
        return parser.add_argument

    text = "Create this host's key and print the command that allows it on the other host."
    add = with_folder("new", "create this host's key", make, "new robot", text)
    add("name", metavar="NAME", nargs="?", help="name of this host (default: its host name)")
    text = "replace an existing key; every other host must then allow the new one"
    add("--force", action="store_true", help=text)
    text = "List this host's public key and the allowed hosts."
    with_folder("list", "list this host's key and the allowed hosts", show, "list", text)
    text = "Allow another host. A running bridge applies this at once. An existing name gets the new key or role."
    add = with_folder("allow", "allow another host", let_in, "allow station ick_...", text)
    add("name", metavar="NAME", help="name for the other host")
    add("key", metavar="KEY", help="its public key, from `ic keys list` on that host")
    text = "viewer receives only (default: driver)"
    add("--role", choices=("driver", "viewer"), default="driver", help=text)
    text = "Remove a host from the list. A running bridge disconnects it at once."
    add = with_folder("revoke", "no longer allow another host", shut_out, "revoke station", text)
    add("name", metavar="NAME", help="name given to ic keys allow")


def _store(args: argparse.Namespace) -> KeyStore:
    from instant_ic.bridge.host_keys import KeyStore

    return KeyStore(args.dir)


def host_name() -> str:
    """Return this machine's host name in the form that the link accepts."""
    import re
    import socket

    name = re.sub(r"[^A-Za-z0-9_-]", "_", socket.gethostname().partition(".")[0])[:63]
    return name if name[:1].isalpha() else f"host_{name}"[:63]


def _create(store: KeyStore, name: str, force: bool = False) -> None:
    from instant_ic.bridge.host_keys import key_text

    identity = store.create(name, force)
    print(f"created the key of {identity.name} in {store.folder} (fingerprint {identity.fingerprint})")
    print(f"on the other host run:\n\n  ic keys allow {identity.name} {key_text(identity.public_key)}\n")


def make(args: argparse.Namespace) -> int:
    """Create this host's key."""
    _create(_store(args), args.name or host_name(), args.force)
    return 0


def show(args: argparse.Namespace) -> int:
    """Print this host's key and the allowed hosts."""
    from instant_ic.bridge.host_keys import key_text
    from instant_ic.cli.tables import print_table

    store = _store(args)
    rows = [("allowed", p.name, p.role, p.fingerprint, key_text(p.public_key)) for p in store.peers()]
    if store.identity_path.exists():
        own = store.identity()
        rows.insert(0, ("this host", own.name, "", own.fingerprint, key_text(own.public_key)))
    else:
        print("this host: no key yet (ic keys new)")
    if rows:
        print_table(rows, ("", "HOST", "ROLE", "FINGERPRINT", "KEY"))
    return 0


def let_in(args: argparse.Namespace) -> int:
    """Allow a host; also create this host's own key if it has none, since the link needs one."""
    from instant_ic.bridge.host_keys import Peer, check_name, parse_key

    store = _store(args)
    peer = Peer(check_name(args.name), args.role, parse_key(args.key))
    if store.identity_path.exists() and store.identity().public_key == peer.public_key:
        raise UserError("this is this host's own key: allow it on the other host, and the other host's key here")
    done = store.allow(peer)
    print(f"{peer.name} ({peer.role}, fingerprint {peer.fingerprint}): {done}")
    if not store.identity_path.exists():
        _create(store, host_name())
    return 0


def shut_out(args: argparse.Namespace) -> int:
    """Remove a host from the allowed ones."""
    peer = _store(args).revoke(args.name)
    print(f"{peer.name} (fingerprint {peer.fingerprint}) is no longer allowed")
    return 0
