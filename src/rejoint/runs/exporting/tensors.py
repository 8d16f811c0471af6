"""Formulas written as nodes of an ONNX graph, with the signs of arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from onnx import GraphProto, NodeProto, TensorProto, helper, numpy_helper

Setting: TypeAlias = int | float | str | GraphProto
"""Of a node"""

_FORWARD, _BACKWARD = [1, 2, 0], [2, 0, 1]  # the coordinates that a vector product takes


@dataclass(eq=False)
class Graph:
    """Nodes in the order of computation, and the constants that they take; all of float64 unless said otherwise.

    A loop's body is a graph with nodes of its own and the constants of the one around it.
    """

    nodes: list[NodeProto] = field(default_factory=list)
    constants: dict[str, NDArray[Any]] = field(default_factory=dict)
    scope: str = ""
    """before the names of all results; another one in every body"""

    def constant(self, value: ArrayLike, dtype: DTypeLike = np.float64) -> Tensor:
        """Return a number, or an array of them."""
        name = f"c{len(self.constants)}"
        self.constants[name] = np.asarray(value, dtype=dtype)
        return Tensor(self, name)

    def node(self, kind: str, *inputs: Tensor | ArrayLike, **settings: Setting) -> Tensor:
        """Append a node with one output, and return that."""
        names = [self.tensor(one).name for one in inputs]
        output = f"{self.scope}{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, names, [output], **settings))
        return Tensor(self, output)

    def tensor(self, value: Tensor | ArrayLike) -> Tensor:
        """Return a tensor as it is, and a number as a constant."""
        return value if isinstance(value, Tensor) else self.constant(value)

    def joined(self, parts: Sequence[Tensor]) -> Tensor:
        """Return tensors one behind the other."""
        return self.node("Concat", *parts, axis=0)

    def initializers(self) -> list[TensorProto]:
        """Return the constants as ONNX keeps them."""
        return [numpy_helper.from_array(value, name) for name, value in self.constants.items()]


@dataclass(frozen=True, eq=False)
class Tensor:
    """A result of a node, an input, or a constant."""

    graph: Graph
    name: str

    def __add__(self, other: Tensor | ArrayLike) -> Tensor:
        return self.graph.node("Add", self, other)

    def __sub__(self, other: Tensor | ArrayLike) -> Tensor:
        return self.graph.node("Sub", self, other)

    def __mul__(self, other: Tensor | ArrayLike) -> Tensor:
        return self.graph.node("Mul", self, other)

    def __truediv__(self, other: Tensor | ArrayLike) -> Tensor:
        return self.graph.node("Div", self, other)

    def __matmul__(self, other: Tensor | ArrayLike) -> Tensor:
        return self.graph.node("MatMul", self, other)

    def __gt__(self, other: Tensor | ArrayLike) -> Tensor:
        return self.graph.node("Greater", self, other)

    def __lt__(self, other: Tensor | ArrayLike) -> Tensor:
        return self.graph.node("Less", self, other)

    def __and__(self, other: Tensor) -> Tensor:
        return self.graph.node("And", self, other)

    def __or__(self, other: Tensor) -> Tensor:
        return self.graph.node("Or", self, other)

    def __invert__(self) -> Tensor:
        return self.graph.node("Not", self)

    @property
    def T(self) -> Tensor:  # noqa: N802 - as NumPy has it
        """The transpose."""
        return self.graph.node("Transpose", self)

    def apply(self, kind: str) -> Tensor:
        """Return the result of an operator of one argument, such as ``Tanh``."""
        return self.graph.node(kind, self)

    def pick(self, index: int | Sequence[int], axis: int = 0) -> Tensor:
        """Return the entries at an ``index``, or at several."""
        return self.graph.node("Gather", self, self.graph.constant(index, np.int64), axis=axis)

    def part(self, start: int, stop: int) -> Tensor:
        """Return the entries from ``start`` to before ``stop``."""
        return self.pick(range(start, stop))

    def shaped(self, *shape: int) -> Tensor:
        """Return the same entries in another shape."""
        return self.graph.node("Reshape", self, self.graph.constant(shape, np.int64))

    def between(self, low: Tensor | ArrayLike, high: Tensor | ArrayLike) -> Tensor:
        """Return the values, limited."""
        return self.graph.node("Min", self.graph.node("Max", self, low), high)

    def at_least(self, low: Tensor | ArrayLike) -> Tensor:
        """Return the larger one."""
        return self.graph.node("Max", self, low)

    def at_most(self, high: Tensor | ArrayLike) -> Tensor:
        """Return the smaller one."""
        return self.graph.node("Min", self, high)

    def largest(self) -> Tensor:
        """Return the size () of the largest entry."""
        return self.graph.node("ReduceMax", self.apply("Abs"), keepdims=0)

    def norm(self) -> Tensor:
        """Return the length () of a vector."""
        return self.graph.node("ReduceSum", self * self, keepdims=0).apply("Sqrt")

    def cross(self, other: Tensor) -> Tensor:
        """Return the vector products of the rows (k, 3) of two matrices."""
        ahead, behind = _FORWARD, _BACKWARD
        return self.pick(ahead, 1) * other.pick(behind, 1) - self.pick(behind, 1) * other.pick(ahead, 1)


def where(condition: Tensor, yes: Tensor | ArrayLike, no: Tensor | ArrayLike) -> Tensor:
    """Return ``yes`` where the condition holds, else ``no``."""
    return condition.graph.node("Where", condition, yes, no)


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve for (3,) with a symmetric ``matrix`` (3, 3), by its cofactors: ONNX has no operator for it."""
    cofactors = matrix.pick(_FORWARD).cross(matrix.pick(_BACKWARD))
    determinant = matrix.graph.node("ReduceSum", matrix.pick(0) * cofactors.pick(0), keepdims=0)
    # Vectors stand on the left: ONNX Runtime 1.31 fuses a transpose with a product by a vector to something wrong.
    return right @ cofactors / determinant
