"""Opens a recording for an experiment, or names its missing topics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from instant_ic.bag.errors import BagError
from instant_ic.bag.files import BagReader


@contextlib.contextmanager
def opened(
    bag: Path, kinds: Mapping[str, tuple[str, ...]], remedy: str = "", optional: str = ""
) -> Iterator[BagReader]:
    """Open a bag that has these topics.

    Args:
        bag: folder or file.
        kinds: types that each topic may have, without their package.
        remedy: advice at the end of the error if a topic is missing.
        optional: topic that may be missing.

    Raises:
        ValueError: not a bag, a damaged one, or a topic is missing or has another type; names it.
    """
    try:
        with BagReader(bag) as reader:
            types = {one.topic: one.type_name.rpartition("/")[2] for one in reader.topics}
            if missing := [topic for topic in kinds if topic not in types and topic != optional]:
                lacks = f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
                has = ", ".join(sorted(types)) or "none"
                raise ValueError(f"{bag}: {lacks}; the bag has these topics: {has}{remedy}")
            if wrong := [
                f"{topic} has the type {types[topic]}, not {allowed[0]}"
                for topic, allowed in kinds.items()
                if types.get(topic, allowed[0]) not in allowed
            ]:
                raise ValueError(f"{bag}: {'; '.join(wrong)}")
            yield reader
    except BagError as error:
        raise ValueError(str(error)) from error
