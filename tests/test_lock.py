"""Both lock files, constraints.txt, pyproject.toml and the installed packages agree; needs no network."""

import importlib.metadata
import re
import tomllib
from pathlib import Path

import hatchling.build
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
APART = {"torch", "uv"}
"""Pinned and not locked: torch is installed by scripts/install_torch.sh, uv by scripts/lock.sh alone."""
LOCKS = [ROOT / "requirements.lock", ROOT / "requirements-test.lock"]
ADVICE = "run `make lock` and commit what it wrote"


def pinned(requirement):
    (specifier,) = requirement.specifier
    assert specifier.operator == "=="
    return specifier.version


def applies(requirement):
    return requirement.marker is None or requirement.marker.evaluate({"extra": ""})


def by_name(lines):
    return {canonicalize_name(one.name): one for one in map(Requirement, filter(None, lines))}


@pytest.fixture(scope="module")
def everywhere():
    """Name → requirement of every locked package, also of those for another machine or Python; all have hashes."""
    text = re.sub(r"^#.*\n", "", "".join(file.read_text() for file in LOCKS), flags=re.MULTILINE)
    entries = [line.split(" --hash=") for line in text.replace("\\\n", " ").splitlines()]
    for words, *hashes in entries:
        assert hashes, f"{words} has no hash: {ADVICE}"
        assert all(re.fullmatch(r"sha256:[0-9a-f]{64}", one.strip()) for one in hashes)
    return by_name(words.strip() for words, *_ in entries)


@pytest.fixture(scope="module")
def lock(everywhere):
    """The same, of those that this machine installs."""
    return {name: one for name, one in everywhere.items() if applies(one)}


@pytest.fixture(scope="module")
def constraints():
    return by_name(line.partition("#")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines())


def test_lock_and_constraints_pin_the_same_versions(lock, everywhere, constraints):
    assert set(lock) <= set(constraints), "pin what is locked in constraints.txt too"
    assert not APART & set(everywhere)
    for name in set(constraints) - APART:
        assert name in everywhere, f"{name} is not locked: {ADVICE}"
        assert pinned(everywhere[name]) == pinned(constraints[name]), f"{name}: {ADVICE}"


def test_lock_satisfies_every_dependency_of_the_project(lock, constraints, monkeypatch):
    monkeypatch.chdir(ROOT)  # the build backend reads the project there
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    asked = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    asked += hatchling.build.get_requires_for_build_editable()
    asked += [one for some in extras.values() for one in some]
    for requirement in map(Requirement, asked):
        if applies(requirement):
            name = canonicalize_name(requirement.name)
            version = pinned(constraints[name] if name in APART else lock[name])
            assert requirement.specifier.contains(version), f"{requirement}: {version} is locked; {ADVICE}"


def test_everything_that_the_locked_packages_and_torch_need_is_locked(lock):
    """A package that only its parent's metadata names would be installed unlocked, or be missing with --no-deps."""
    for name in [*lock, "torch"]:
        try:
            needed = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            pytest.fail(f"{name} is locked and not installed: run make install")
        for requirement in map(Requirement, needed):
            if applies(requirement):
                inner = canonicalize_name(requirement.name)
                assert inner in lock, f"{name} needs {requirement}: {ADVICE}"
                assert requirement.specifier.contains(pinned(lock[inner]))


def test_installed_versions_are_the_locked_ones(lock):
    installed = {name: importlib.metadata.version(name) for name in lock}
    assert installed == {name: pinned(one) for name, one in lock.items()}


def test_lock_names_no_address_of_an_index(lock):
    for lock in LOCKS:
        assert not re.search(r"https?:|file:|--\w*index|find-links", lock.read_text())


def test_make_install_takes_packages_from_the_lock_alone():
    """The installation checks hashes, and no later step lets pip resolve dependencies."""
    makefile = (ROOT / "Makefile").read_text()
    installs = re.findall(r"^\t@\$\(PIP\) (.*)$", makefile, flags=re.MULTILINE)
    assert installs == [
        "--require-hashes --only-binary :all: -r requirements.lock",
        "--no-deps --no-build-isolation -e .",
        "--require-hashes --only-binary :all: -r requirements-test.lock",
    ]
