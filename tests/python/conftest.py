"""What holds for all tests."""

import gc
import signal

import pytest
import torch
from hypothesis import settings

# The same cases in every run; `pytest --hypothesis-profile default` draws new ones.
settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")

# A shell starts what it runs in the background with Ctrl-C ignored, and children inherit that: the tests
# that interrupt a training would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def data_cache(tmp_path_factory):
    """Data sets are made anew by the code under test, once, and not read from the user's own cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PRDP_CACHE", str(tmp_path_factory.mktemp("data")))
        yield


@pytest.fixture
def always():
    """A warning that is said once in a process is said each time."""
    torch.set_warn_always(True)
    yield
    torch.set_warn_always(False)


@pytest.fixture
def no_callbacks_of_the_collector():
    """For tests that interrupt: Python drops what a callback raises, an interrupt too, and hypothesis has one."""
    callbacks = gc.callbacks[:]
    gc.callbacks.clear()
    yield
    gc.callbacks.extend(callbacks)
