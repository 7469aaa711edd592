"""Torch on one thread: on a busy machine its threads wait for each other far longer than they compute."""

import sys

import pytest


@pytest.fixture(autouse=True, scope="session")
def one_torch_thread():
    torch = sys.modules.get("torch")
    if torch is None:  # no test of this run uses it
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
