"""What all settings and cards have in common."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict


class StrictModel(BaseModel):
    """A frozen value that refuses a name that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def with_values(self, **values: object) -> Self:
        """Return a copy with these values; unlike `model_copy`, it refuses unknown names and values out of bounds.

        Raises ValueError.
        """
        if unknown := sorted(values.keys() - type(self).model_fields.keys()):
            raise ValueError(f"{type(self).__name__} has no setting named {', '.join(unknown)}")
        return type(self).model_validate(dict(self) | values)
