"""A policy file judged before ONNX Runtime reads it: a bounded chain of known layers, and the metadata beside it.

An ONNX model may loop, call operators of other libraries, name files beside it for its weights, and ask for any amount
of memory. The network of a policy does none of it, so that a reader of its few messages can refuse whatever else
a file holds. Encoding: protobuf.dev, "Encoding"; fields: ``onnx.proto`` of ONNX 1.17.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

LAYERS = ("Gemm", "Elu", "Tanh", "Clip")
"""Operators that a policy's network is made of"""

MOST_LAYERS = 64
"""(chosen: ours have seven)"""

_MODEL = {1, 2, 3, 4, 5, 6, 7, 8, 14}  # all but training, functions and devices
_GRAPH, _OPSET, _PROPERTY = 7, 8, 14
_NODE, _WEIGHT = 1, 5
_GRAPH_FIELDS = {1, 2, 5, 10, 11, 12, 13}  # all but sparse and quantised weights
_OPERATOR, _ATTRIBUTE, _DOMAIN = 4, 5, 7
_NODE_FIELDS = {1, 2, 3, 4, 5, 6, 7}
_ATTRIBUTE_FIELDS = {1, 2, 3, 4, 13, 20, 21}  # numbers and text: no tensors and no graphs inside
_WEIGHT_FIELDS = {1, 2, 4, 8, 9, 12}  # float32 inside the file: no segments, no other file

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def read_metadata(data: bytes) -> dict[str, str]:
    """Return the metadata of an ONNX file with the network of a policy; ValueError says what else it holds."""
    found: dict[str, str] = {}
    layers = 0
    for number, value in _known(data, _MODEL, "model"):
        if number == _GRAPH:
            layers += _judge_graph(value)
        elif number == _OPSET:
            if any(field == 1 and domain for field, domain in _fields(value)):
                raise ValueError("it names operators of another library")
        elif number == _PROPERTY:
            pair = dict(_known(value, {1, 2}, "metadata"))
            found[_text(pair.get(1, b""))] = _text(pair.get(2, b""))
    if not 0 < layers <= MOST_LAYERS:
        raise ValueError(f"{layers} layers, expected 1 to {MOST_LAYERS}")
    return found


def content_digest(data: bytes, contract: str) -> str:
    """Digest everything that an ONNX file holds but its metadata, and the text of its contract; ValueError as above."""
    digest = hashlib.sha256()
    for number, value in _fields(data):
        if number != _PROPERTY:
            digest.update(f"{number} {len(value)} ".encode() + value)
    digest.update(contract.encode())
    return digest.hexdigest()


def _judge_graph(data: bytes) -> int:
    """Refuse (ValueError) a graph that is no chain of layers with weights in the file; returns how many layers."""
    layers = 0
    for number, value in _known(data, _GRAPH_FIELDS, "graph"):
        if number == _NODE:
            layers += 1
            node = list(_known(value, _NODE_FIELDS, "layer"))
            operators = [_text(part) for field, part in node if field == _OPERATOR]
            if len(operators) != 1 or operators[0] not in LAYERS or any(f == _DOMAIN and part for f, part in node):
                raise ValueError(f"a layer {operators}, expected one of {', '.join(LAYERS)}"[:200])
            for field, part in node:
                if field == _ATTRIBUTE:
                    list(_known(part, _ATTRIBUTE_FIELDS, "layer's setting"))
        elif number == _WEIGHT:
            list(_known(value, _WEIGHT_FIELDS, "weight"))
    return layers


def _known(data: bytes, fields: set[int], what: str) -> Iterator[tuple[int, bytes]]:
    """Yield the fields of a message; ValueError at one that a policy's has not."""
    for number, value in _fields(data):
        if number not in fields:
            raise ValueError(f"a {what} with a field {number}")
        yield number, value


def _fields(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield number and content of every field of a message; that of a number is its bytes."""
    place = 0
    while place < len(data):
        key, start = _varint(data, place)
        kind = key & 7
        if kind == _VARINT:
            _, place = _varint(data, start)
        elif kind == _FIXED64:
            place = start + 8
        elif kind == _FIXED32:
            place = start + 4
        elif kind == _BYTES:
            size, start = _varint(data, start)
            place = start + size
        else:
            raise ValueError(f"byte {place} begins no field")
        if place > len(data):
            raise ValueError("cut short")
        yield key >> 3, data[start:place]


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """Read a number of seven bits a byte, and where the next thing begins."""
    number = 0
    for shift in range(0, 70, 7):
        if place >= len(data):
            raise ValueError("cut short")
        byte = data[place]
        place += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, place
    raise ValueError(f"byte {place} ends no number")


def _text(value: bytes) -> str:
    try:
        return value.decode()
    except UnicodeDecodeError as error:
        raise ValueError("text that is none") from error
