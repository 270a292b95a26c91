"""The package's own door: its names, its version, and what opening it costs."""

from importlib import metadata
import subprocess
import sys

import pytest

import vcbf_drake


@pytest.mark.parametrize("name", vcbf_drake.__all__)
def test_a_public_name_is_what_its_module_says(name):
    assert name in dir(vcbf_drake)
    value = getattr(vcbf_drake, name)
    assert getattr(value, "__module__", "vcbf_drake").startswith("vcbf_drake")


def test_what_is_no_public_name_is_no_attribute():
    with pytest.raises(AttributeError, match="has no attribute 'chebyshev_ball'"):
        _ = vcbf_drake.chebyshev_ball


def test_the_version_is_the_installed_ones():
    try:
        installed = metadata.version("vcbf-drake")
    except metadata.PackageNotFoundError:
        pytest.skip("a checkout on the path")
    assert vcbf_drake.__version__ == installed


def test_opening_the_package_loads_nothing_else():
    code = "import sys, vcbf_drake; print([m for m in sys.modules if 'drake' in m])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "['vcbf_drake']"
