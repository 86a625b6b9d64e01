"""Base of all models of the contract."""

from pydantic import BaseModel, ConfigDict


class Schema(BaseModel):
    """A model that refuses unknown fields."""

    model_config = ConfigDict(extra="forbid")
