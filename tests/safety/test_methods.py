"""The methods against what their papers do."""

import pytest

from vcbf_drake.safety import METHODS, FilterSettings


def test_methods_do_what_their_papers_do():
    choices = {
        n: (m.disturbance, m.feasibility, m.observer) for n, m in METHODS.items()
    }
    assert choices == {
        "cbf-qp": ("ignored", "none", "rise"),
        "robust-cbf-qp": ("worst_case", "none", "rise"),
        "wang-xu-dob-cbf-qp": ("estimated", "none", "linear"),
        "vcbf-qp": ("ignored", "volume", "rise"),
        "dob-cbf-qp": ("estimated", "none", "rise"),
        "dob-vcbf-qp": ("estimated", "volume", "rise"),
        "optimal-decay": ("estimated", "decay", "rise"),
        "backup": ("estimated", "backup", "rise"),
    }
    assert all(method.source for method in METHODS.values())


def test_a_method_that_is_none_is_refused():
    with pytest.raises(ValueError, match="method: 'magic'; it must be one of cbf"):
        FilterSettings(method="magic")
