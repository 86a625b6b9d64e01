"""The identity of an engine on its way through the handshake."""

import pytest

from trompe_shared.engine import EngineInfo
from trompe_shared.errors import ProtocolError


def test_an_identity_comes_back_from_its_text() -> None:
    engine = EngineInfo("three", "0.180.0", "tone=agx", deterministic=False)
    assert EngineInfo.from_text(engine.to_text()) == engine


@pytest.mark.parametrize(
    "text",
    [
        "three",
        "[]",
        '{"name": "three"}',
        '{"name": 3, "version": "0.180.0"}',
        '{"name": "three", "version": "0.180.0", "deterministic": "yes"}',
        pytest.param("[" * 30_000, id="nested deeply"),
    ],
)
def test_any_other_text_is_refused(text: str) -> None:
    with pytest.raises(ProtocolError, match="not the identity of an engine"):
        EngineInfo.from_text(text)
