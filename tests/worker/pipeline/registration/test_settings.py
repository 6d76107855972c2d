from __future__ import annotations

import pytest
from pydantic import ValidationError

from worker.pipeline.registration.settings import RegistrationSettings

SETTINGS = RegistrationSettings()


def test_the_inlier_ratio_is_understood_under_its_own_and_under_the_apis_name() -> None:
    """Maps that were stored with `min_agreement` are read, and the API still says so."""
    for name in ("min_inlier_ratio", "min_agreement"):
        assert RegistrationSettings.model_validate({name: 0.7}).min_inlier_ratio == 0.7


def test_with_values_changes_what_is_named_and_nothing_else() -> None:
    changed = SETTINGS.with_values(min_inlier_ratio=0.9, coarse_distances=(0.3,))
    assert (changed.min_inlier_ratio, changed.coarse_distances) == (0.9, (0.3,))
    assert changed.with_values(min_inlier_ratio=0.8, coarse_distances=(0.6, 0.3, 0.1)) == SETTINGS


@pytest.mark.parametrize("name", ["min_inlier_ration", "min_agreement"])
def test_with_values_refuses_a_name_that_no_setting_has(name: str) -> None:
    """`model_copy` would accept it silently; so would validation an alias beside the name."""
    with pytest.raises(ValueError, match=f"RegistrationSettings has no setting named {name}"):
        SETTINGS.with_values(**{name: 0.9})


def test_with_values_refuses_a_value_out_of_bounds() -> None:
    with pytest.raises(ValidationError, match="min_overlap"):
        SETTINGS.with_values(min_overlap=1.5)
