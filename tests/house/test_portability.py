"""The command that runs the tests as on other machines: it restricts what it says, and tells what
fails.
"""

import platform

import portability
import pytest

from polysft_mi.errors import InputError

pytestmark = pytest.mark.skipif(platform.machine() != "x86_64", reason="instruction sets of x86-64")

TESTS = """
import portability

def test_of_rounding():
    assert sum([0.1] * 10) == 1

def test_of_what_is_in_force():
    said = ", ".join(portability.in_force())
    assert all(words in said for words in {words})

def test_that_computes():
    import drjit as dr
    import mitsuba as mi

    assert dr.sum(dr.fma(dr.arange(mi.Float, 100), 2, 1))[0] == 10000
"""


@pytest.mark.parametrize(
    "name, words",
    [
        ("avx2", ["for haswell, 8 lanes", "OpenCV: AVX2", "OpenBLAS: Haswell"]),
        ("sse", ["for nehalem, 4 lanes", "OpenCV: SSE4.2", "NumPy: X86_V2", "OpenBLAS: Nehalem"]),
        ("eight-threads", ["lanes, 8 threads", ", 8 threads, torch: "]),
    ],
)
def test_an_environment_is_in_force_and_failures_are_named(name, words, tmp_path):
    path = tmp_path / "test_three.py"
    path.write_text(TESTS.format(words=words))
    found = portability.run(name, portability.ENVIRONMENTS[name], [str(path)], tmp_path)
    assert (found["passed"], found["skipped"]) == (2, 0), (tmp_path / f"{name}.log").read_text()
    assert found["failed"] == ["test_three::test_of_rounding"]
    assert all(word in found["in force"] for word in words)
    *_, row = portability.table({name: found})
    assert row.startswith(f"| {name} | 2 | 0 | 1; `test_three::test_of_rounding` | ")


def test_what_runs_no_test_is_refused(tmp_path):
    with pytest.raises(InputError, match="no test has ended"):
        portability.run("host", {}, [str(tmp_path / "gone.py")], tmp_path)
    with pytest.raises(InputError, match="choose among host, avx2, sse"):
        portability.main(["--only", "mmx", "-o", str(tmp_path)])
