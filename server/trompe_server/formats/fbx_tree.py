"""Binary FBX as a tree of nodes, to find and replace the pictures inside."""

import re
import struct
from dataclasses import dataclass, replace
from typing import Final

from trompe_shared.errors import ObjectError
from trompe_shared.local_files import base_name

MAGIC: Final = b"Kaydara FBX Binary  \0\x1a\0"
MAX_DEPTH: Final = 32
WIDE: Final = 7500
"""First version with offsets of 64 bits."""
_ID: Final = 16
"""Bytes of the footer before its padding: an identification."""
_END: Final = 140
"""Bytes of the footer after its padding: version, zeros, a mark."""


@dataclass(frozen=True)
class Node:
    """properties: ``count`` encoded values. children: ``None`` without a list of children."""

    name: bytes
    count: int
    properties: bytes
    children: "tuple[Node, ...] | None"

    def child(self, name: bytes) -> "Node | None":
        return next((child for child in self.children or () if child.name == name), None)


@dataclass(frozen=True)
class Tree:
    """A file; ``footer``: the bytes after its nodes."""

    version: int
    nodes: tuple[Node, ...]
    footer: bytes

    def pictures(self) -> dict[str, bytes]:
        """The image files inside, by their names in materials. Raises ``ObjectError`` for two of one name."""
        found: dict[str, bytes] = {}
        objects = (node for top in self.nodes if top.name == b"Objects" for node in top.children or ())
        for name, content in (_picture(node) for node in objects if node.name == b"Video"):
            if content is not None and found.setdefault(name, data := content.properties[5:]) != data:
                raise ObjectError(
                    f"The FBX holds two pictures called {name!r}; rename one of them and export it again."
                )
        return found

    def with_pictures(self, pictures: dict[str, bytes | None]) -> "Tree":
        """The tree with other image files; ``None`` removes a file."""
        return replace(self, nodes=tuple(_replaced(node, pictures) for node in self.nodes))

    def with_links(self, name: re.Pattern[bytes], new: bytes) -> "Tree":
        """The tree with the property ``new`` of materials in connections to a property that matches ``name``."""
        text = b"S" + struct.pack("<I", len(new)) + new
        return replace(self, nodes=tuple(_linked(node, name, text) for node in self.nodes))

    def to_bytes(self) -> bytes:
        """The file's bytes."""
        header, out = _header(self.version), bytearray(MAGIC + struct.pack("<I", self.version))
        for node in self.nodes:
            _write(node, out, header)
        out += bytes(header.size + 1)
        if len(self.footer) < _ID + _END:
            return bytes(out + self.footer)
        out += self.footer[:_ID]
        out += bytes(16 - len(out) % 16) + self.footer[-_END:]
        return bytes(out)


def parse_tree(data: bytes) -> Tree:
    """Parse a binary FBX. Raises ``ObjectError``."""
    try:
        (version,) = struct.unpack_from("<I", data, len(MAGIC))
        nodes, end = _parse(data, len(MAGIC) + 4, len(data), _header(version), 0)
    except (struct.error, IndexError) as error:
        raise ObjectError(f"The FBX ends too early ({error}); export it again.") from error
    return Tree(version, nodes, data[end:])


def _header(version: int) -> struct.Struct:
    """Header of a node: its end, the number of its properties, their length."""
    return struct.Struct("<QQQ" if version >= WIDE else "<III")


def _parse(data: bytes, position: int, end: int, header: struct.Struct, depth: int) -> tuple[tuple[Node, ...], int]:
    """(Nodes from ``position`` up to the empty one that ends their list, end of the list)."""
    nodes: list[Node] = []
    while position < end:
        node_end, count, length = header.unpack_from(data, position)
        start = position + header.size + 1
        if node_end == 0:
            return tuple(nodes), start
        name = data[start : start + data[start - 1]]
        body = start + len(name) + length
        if not position < node_end <= end or body > node_end or depth > MAX_DEPTH:
            raise ObjectError(f"The FBX's nodes overlap (at byte {position}); export it again.")
        children = _parse(data, body, node_end, header, depth + 1)[0] if body < node_end else None
        nodes.append(Node(name, count, data[body - length : body], children))
        position = node_end
    return tuple(nodes), position


def _write(node: Node, out: bytearray, header: struct.Struct) -> None:
    start = len(out)
    out += bytes(header.size) + bytes([len(node.name)]) + node.name + node.properties
    for child in node.children or ():
        _write(child, out, header)
    if node.children is not None:
        out += bytes(header.size + 1)
    header.pack_into(out, start, len(out), node.count, len(node.properties))


def _picture(video: Node) -> tuple[str, Node | None]:
    """(Name of a picture, node of its bytes if they are inside)."""
    content = video.child(b"Content")
    named = video.child(b"RelativeFilename") or video.child(b"Filename")
    inside = content is not None and content.properties[:1] == b"R" and len(content.properties) > 5
    name = named.properties[5:].decode("utf-8", "replace") if named is not None else ""
    return base_name(name), content if inside else None


def _linked(node: Node, name: re.Pattern[bytes], new: bytes) -> Node:
    if node.name != b"Connections":
        return node
    links = (replace(link, properties=name.sub(lambda _: new, link.properties)) for link in node.children or ())
    return replace(node, children=tuple(links))


def _replaced(node: Node, pictures: dict[str, bytes | None]) -> Node:
    if node.name == b"Objects":
        return replace(node, children=tuple(_replaced(child, pictures) for child in node.children or ()))
    name, content = _picture(node) if node.name == b"Video" else ("", None)
    if content is None or name not in pictures or node.children is None:
        return node
    data = pictures[name]
    new = () if data is None else (replace(content, properties=b"R" + struct.pack("<I", len(data)) + data),)
    children = (new if child is content else (child,) for child in node.children)
    return replace(node, children=tuple(child for some in children for child in some))
