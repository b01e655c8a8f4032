"""The base of every table in a scene, protocol or certificate file: strict types, no unknown keys, no NaN or inf."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Table(BaseModel):
    """A TOML table. Keys carry their unit (``thickness_um``); lists are ``list``, never tuples."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
