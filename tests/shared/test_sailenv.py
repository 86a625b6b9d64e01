"""The wire codec: round trips, and refusal of malformed bytes."""

import gzip
import io
import math
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trompe_shared import sailenv
from trompe_shared.errors import ProtocolError, RendererError
from trompe_shared.sailenv import COMMANDS, REGISTER, VIEW_FLAGS, Command, decode_frame, decode_request, encode_frame

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=30)
floats = st.floats(width=32, allow_nan=False)
ints = st.integers(-(2**31), 2**31 - 1)
unsigned = st.integers(0, 2**32 - 1)
CODES = [bytes([command.code]) for command in COMMANDS.values() if command.code is not None]


def reader(data: bytes) -> Callable[[int], bytes]:
    """Reads ``data``, and raises EOFError where it ends as a closed socket does."""
    stream = io.BytesIO(data)

    def read(count: int) -> bytes:
        part = stream.read(count)
        if len(part) < count:
            raise EOFError
        return part

    read.rest, read.position = stream.read, stream.tell  # type: ignore[attr-defined]
    return read


def rest(read: Any) -> bytes:
    return bytes(read.rest())


def values_of(kind: Any) -> st.SearchStrategy[Any]:
    """Values that a field of ``kind`` can carry."""
    if isinstance(kind, sailenv._Numbers):
        one = {"B": st.integers(0, 255), "?": st.booleans(), "i": ints, "I": unsigned, "f": floats}[kind.format]
        return one if kind.count == 1 else st.tuples(*[one] * kind.count)
    if isinstance(kind, sailenv._ClientText | sailenv._ServerText):
        return texts
    if isinstance(kind, sailenv._File):
        return st.tuples(texts, st.binary(max_size=50))
    if isinstance(kind, sailenv._Dynamic):
        return st.none() | st.tuples(texts, texts)
    if isinstance(kind, sailenv._Scenario):
        return st.fixed_dictionaries({"objects": st.lists(st.dictionaries(texts, texts), max_size=3)})
    if isinstance(kind, sailenv._Pixels):
        sides = st.tuples(st.integers(0, 3), st.integers(0, 3))
        return sides.flatmap(
            lambda s: st.binary(min_size=3 * s[0] * s[1], max_size=3 * s[0] * s[1]).map(lambda b: (*s, b))
        )
    if isinstance(kind, sailenv._Changes):
        return st.lists(st.tuples(st.just("set_position"), requests_of(COMMANDS["set_position"])), max_size=3)
    cells = [values_of(cell) for cell in kind.kinds]
    return st.lists(cells[0] if len(cells) == 1 else st.tuples(*cells), max_size=5)


def requests_of(command: Command) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({name: values_of(kind) for name, kind in command.request.items()})


def requests() -> st.SearchStrategy[tuple[Command, dict[str, Any]]]:
    return st.sampled_from([*COMMANDS.values()]).flatmap(lambda c: requests_of(c).map(lambda values: (c, values)))


def replies() -> st.SearchStrategy[tuple[Command, tuple[Any, ...]]]:
    return st.sampled_from([*COMMANDS.values(), REGISTER]).flatmap(
        lambda c: st.tuples(*map(values_of, c.reply)).map(lambda values: (c, values))
    )


@given(requests(), st.binary(max_size=4))
def test_a_request_is_read_as_it_was_written_and_nothing_after_it(pair: Any, after: bytes) -> None:
    command, values = pair
    read = reader(command.encode_request(**values) + after)
    found = decode_request(read, is_long=lambda: False)
    assert found[0] is command
    assert found[1] == values
    assert rest(read) == after


@given(replies(), st.binary(max_size=4))
def test_a_reply_is_read_as_it_was_written_and_nothing_after_it(pair: Any, after: bytes) -> None:
    command, values = pair
    read = reader(command.encode_reply(*values) + after)
    assert command.decode_reply(read) == values
    assert rest(read) == after


@given(requests_of(REGISTER))
def test_a_handshake_starts_with_the_size_and_no_code(values: dict[str, Any]) -> None:
    data = REGISTER.encode_request(**values)
    assert data[:8] == struct.pack("<ii", values["width"], values["height"])
    assert REGISTER.decode_fields(reader(data)) == values


@given(st.text(st.sampled_from("aàß€漢🏺"), max_size=40), st.binary(max_size=9))
def test_a_clients_text_counts_code_points_and_a_servers_counts_bytes(text: str, after: bytes) -> None:
    utf8 = text.encode()
    request = COMMANDS["change_scene"].encode_request(scene=text)
    assert request == b"\x02" + struct.pack("<i", len(text)) + utf8
    read = reader(request + after)
    assert decode_request(read, is_long=lambda: False)[1] == {"scene": text}
    assert rest(read) == after
    assert COMMANDS["send_obj_zip"].encode_reply(text) == struct.pack("<i", len(utf8)) + utf8


@given(st.lists(texts, max_size=5), st.binary(max_size=4))
def test_a_scenarios_reply_has_as_many_texts_as_the_request_asks_for(ids: list[str], after: bytes) -> None:
    command = COMMANDS["load_scenario"]
    read = reader(command.encode_reply(*ids) + after)
    assert [command.decode_reply(read)[0] for _ in ids] == ids
    assert rest(read) == after


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"objects": 3}', "[" * 100_000, '{"objects": [' + "0," * 5000 + "0]}"]
)
def test_a_scenario_without_a_list_of_objects_of_reasonable_length_is_refused(text: str) -> None:
    data = b"\x1d" + struct.pack("<i", len(text)) + text.encode()
    with pytest.raises(ProtocolError, match="load_scenario"):
        decode_request(reader(data), is_long=lambda: True)


@pytest.mark.parametrize(("command", "value"), [("get_categories", [(-1, "x")]), ("get_light_color", (-1, 0, 0))])
def test_no_negative_number_is_answered_because_the_client_would_read_another(command: str, value: Any) -> None:
    with pytest.raises(ProtocolError):
        COMMANDS[command].encode_reply(value)


SPAWN = {
    "name": "file:x",
    "position": (0.0, 1.0, 2.0),
    "rotation": (3.0, 4.0, 5.0),
    "remove_dynamics": True,
    "scale": (1.0, 1.0, 1.0),
    "use_parent": False,
}


@pytest.mark.parametrize("dynamic", [None, ("uniform_movement_random_bounce", '{"speed": 1}')])
def test_the_long_spawn_is_the_short_one_with_a_tail(dynamic: tuple[str, str] | None) -> None:
    spawn = COMMANDS["spawn_object"]
    short, long = spawn.encode_request(**SPAWN), spawn.encode_request(**SPAWN, frustum_limited=True, dynamic=dynamic)
    assert long.startswith(short)
    assert decode_request(reader(short), is_long=lambda: False)[1] == SPAWN
    expected = SPAWN | {"frustum_limited": True, "dynamic": dynamic}
    assert decode_request(reader(long), is_long=lambda: True)[1] == expected


def test_only_a_command_with_two_dialects_asks_for_the_dialect() -> None:
    data = COMMANDS["set_position"].encode_request(position=(1.0, 2.0, 3.0))
    _, found = decode_request(reader(data), is_long=lambda: pytest.fail("asked"))
    assert found == {"position": (1.0, 2.0, 3.0)}


@given(st.sampled_from([c for c in COMMANDS.values() if c.reply or c.status]), texts)
def test_every_refusal_is_well_formed(command: Command, reason: str) -> None:
    read = reader(command.encode_refusal(reason))
    if command.status:
        with pytest.raises(RendererError, match="refused"):
            command.decode_reply(read)
    else:
        assert command.decode_reply(read) == command.refused
    assert rest(read) == b""


@pytest.mark.parametrize(("reason", "told"), [("too far away", "too far away"), ("ok", "refused")])
def test_a_refusal_carries_its_reason_and_can_never_say_ok(reason: str, told: str) -> None:
    command = COMMANDS["set_position"]
    with pytest.raises(RendererError, match=told):
        command.decode_reply(reader(command.encode_refusal(reason)))


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"\xaa", id="unknown code"),
        pytest.param(b"\x02" + struct.pack("<i", -1), id="negative text length"),
        pytest.param(b"\x02" + struct.pack("<i", 2**16 + 1), id="text too long"),
        pytest.param(b"\x02" + struct.pack("<i", 2) + b"\xff\xff", id="text is not UTF-8"),
        pytest.param(b"\x0c" + struct.pack("<i", 1) + b"x" + struct.pack("<i", 2**30), id="file too long"),
    ],
)
def test_a_malformed_request_is_refused_before_the_announced_bytes_are_read(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        decode_request(reader(data), is_long=lambda: False)


@settings(max_examples=500)
@given(st.binary(max_size=300), st.just(b"") | st.sampled_from(CODES), st.booleans())
def test_random_bytes_are_requests_or_a_protocol_error_or_end_too_early(data: bytes, code: bytes, long: bool) -> None:
    read, position = reader(code + data), 0
    try:
        while True:
            command, _ = decode_request(read, is_long=lambda: long)
            assert (code + data)[position] == command.code
            position = read.position()  # type: ignore[attr-defined]
    except (ProtocolError, EOFError):
        pass


@pytest.mark.parametrize(
    ("command", "values"),
    [
        pytest.param("despawn_object", {"instance": 2**31}, id="int too large"),
        pytest.param("change_scene", {"scene": "x" * (2**16 + 1)}, id="text too long"),
        pytest.param("change_scene", {"scene": "\ud800"}, id="text not UTF-8"),
        pytest.param("set_position", {"position": (0.0, 1.0)}, id="vector too short"),
        pytest.param("set_position", {"rotation": (0.0, 1.0, 2.0)}, id="wrong field"),
    ],
)
def test_values_outside_the_protocol_are_not_sent(command: str, values: dict[str, Any]) -> None:
    with pytest.raises(ProtocolError):
        COMMANDS[command].encode_request(**values)


@given(st.sets(st.sampled_from([*VIEW_FLAGS])), st.binary(max_size=99), st.booleans(), floats)
def test_a_frame_holds_the_views_asked_for_in_the_protocols_order(
    names: set[str], payload: bytes, compress: bool, delta_time: float
) -> None:
    views = {name: payload + name.encode() for name in VIEW_FLAGS if name in names}
    flags = sum(VIEW_FLAGS[name] for name in names)
    pieces = encode_frame([*views.values()], delta_time=delta_time, compress=compress)
    assert len(pieces) == max(len(names), 1)
    found, took = decode_frame(reader(b"".join(pieces)), flags=flags)
    assert {name: gzip.decompress(view) if compress else view for name, view in found.items()} == views
    assert took == delta_time


def test_each_piece_of_a_frame_starts_with_a_length() -> None:
    first, last = encode_frame([b"abc", b"defgh"], delta_time=math.nan, compress=False)
    assert first == struct.pack("<i", 3) + b"abc"
    assert last[:9] == struct.pack("<i", 5) + b"defgh"
    assert len(last) == 13


def test_codes_and_names_are_each_used_once() -> None:
    assert len(set(CODES)) == len(COMMANDS)
    assert all(name == command.name for name, command in COMMANDS.items())
