"""Few programs are compiled, and the same ones serve again, in other processes too."""

import pytest

from .processes import run_module

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    """The same work in two processes, one after the other, that share an empty cache."""
    cached = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("cache")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    parts = "forward", "identify", "eager"
    return [run_module("tests.waiting", *parts, **cached)[0] for _ in range(2)]


def test_an_identification_and_its_report_compile_few_programs(processes):
    first, _ = processes
    assert first["identify"]["programs"] <= 4
    assert first["report"]["programs"] <= 4


def test_a_body_made_outside_of_a_compiled_function_compiles_few_programs(processes):
    first, _ = processes
    assert first["body"]["programs"] <= 6


def test_other_recordings_of_about_the_same_size_compile_nothing(processes):
    first, _ = processes
    for name in ("identify again", "identify, one dropped", "report of it", "identify, two more"):
        assert first[name]["programs"] == 0


def test_a_second_process_finds_all_programs_in_the_cache(processes):
    first, second = processes
    assert first["misses"] > 0
    assert second["misses"] == 0
