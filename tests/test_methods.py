"""The statements of accuracy are well formed; that they hold is shown where each stage is tested."""

from __future__ import annotations

import pytest

from unprocess_gen.methods import METHODS, STAGES, method


def test_every_method_belongs_to_a_stage_and_has_a_name_of_its_own() -> None:
    assert {one.stage for one in METHODS} <= set(STAGES)
    assert len({(one.stage, one.name) for one in METHODS}) == len(METHODS)


def test_errors_are_in_dn_or_sigma_and_what_is_exact_changes_nothing() -> None:
    for one in METHODS:
        assert one.error_unit in ("DN", "σ")
        assert one.error_max > 0 or one.changed_share == 0
        assert 0 <= one.changed_share < 1


def test_a_method_is_found_by_stage_and_name() -> None:
    assert method("normal", "linear").error_unit == "σ"
    with pytest.raises(KeyError, match="normal has no method cubic"):
        method("normal", "cubic")
