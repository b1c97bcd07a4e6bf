"""Exports a policy as an ONNX model, for runtimes without Python; needs the extra `onnx`.

The graph has the operations of `Policy`, so that the two differ only in rounding: the action
follows from the network's outputs (`heads.py`), not from an argmax over all values.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from mjx_balance.files.run_folder import write_atomically
from mjx_balance.policy.heads import points
from mjx_balance.policy.manifest import installed_version
from mjx_balance.policy.network import Policy

OPSET = 17
IR_VERSION = 8  #: the version that goes with opset 17; a higher one would exclude older runtimes
ABOUT = (
    "Greedy policy of mjx_balance. The metadata's inputs say what each entry of the observation "
    "is, in order; the action is a row of actions.table_m in the metadata's manifest, the command "
    "the height changes to make, m."
)


def export_onnx(policy: Policy, path: Path) -> int:
    """Writes a policy as an ONNX model, atomically.

    Args:
      policy: with any head.
      path: file to write.

    Returns:
      Size of the file, bytes.

    Raises:
      OSError: if it cannot be written; an old file then stays.
    """
    content = onnx_model(policy).SerializeToString()
    write_atomically(path, content)
    return len(content)


def onnx_model(policy: Policy) -> onnx.ModelProto:
    """Returns a policy as a checked ONNX model.

    Its input is `observation` (N, obs_size) float32; its outputs are `q_values` (N, num_actions)
    float32, `action` (N,) int64, and `command` (N, 2) float32, m, which is `Policy.command`, for
    any N. The metadata holds `manifest` and `inputs` as JSON. Action and command are valid for any
    observation, even one that is not finite.
    """
    graph = Graph()
    x = "observation"
    for kernel, bias in policy.layers[:-1]:
        x = graph.add("Relu", graph.add("Gemm", x, kernel, bias))
    if policy.radial:
        x = graph.add("Concat", x, "observation", axis=1)
    out = graph.add("Gemm", x, *policy.layers[-1])
    values = (_radial_values if policy.radial else _additive_values)(graph, out, policy)
    graph.add("Identity", values, output="q_values")
    best_action(graph, out, policy.factors, policy.radial, output="action")
    if policy.config.task.action == "continuous":
        peak = best_point(graph, out, len(policy.factors))
        graph.add("Mul", peak, policy.actions.max(axis=0), output="command")
    else:
        graph.add("Gather", policy.actions, "action", output="command")
    inputs: Tensors = {"observation": (np.float32, ("N", policy.observation_size))}
    outputs: Tensors = {
        "q_values": (np.float32, ("N", len(policy.actions))),
        "action": (np.int64, ("N",)),
        "command": (np.float32, ("N", policy.actions.shape[-1])),
    }
    return graph.model("policy", ABOUT, inputs, outputs, policy.manifest)


Tensors = dict[str, tuple[type[np.generic], tuple[int | str, ...]]]
"""Name -> element type and shape."""


class Graph:
    """Operations and constants of a graph."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def add(
        self,
        kind: str,
        *inputs: str | np.ndarray | np.floating,
        output: str = "",
        **attributes: Any,
    ) -> str:
        """Adds an operation; its inputs are names of outputs, or constants. Returns its output."""
        output = output or f"{kind}_{len(self.nodes)}"
        names = [x if isinstance(x, str) else self._constant(x) for x in inputs]
        self.nodes.append(helper.make_node(kind, names, [output], output, **attributes))
        return output

    def columns(self, x: str, start: int, end: int, axis: int = 1) -> str:
        """Slices x, as (N, n) to (N, end - start)."""
        return self.add("Slice", x, *(np.asarray([k]) for k in (start, end, axis)))

    def flat(self, x: str) -> str:
        """The elements of x in one row (n,)."""
        return self.add("Reshape", x, np.asarray([-1]))

    def split(self, x: str, sizes: Sequence[int], outputs: Sequence[str]) -> None:
        """Splits x (n,) into parts of these sizes."""
        sizes_name = self._constant(np.asarray(sizes))
        self.nodes.append(helper.make_node("Split", [x, sizes_name], outputs, axis=0))

    def model(
        self, name: str, about: str, inputs: Tensors, outputs: Tensors, manifest: dict[str, Any]
    ) -> onnx.ModelProto:
        """The checked model, with the manifest in its metadata."""

        def infos(tensors: Tensors) -> list[onnx.ValueInfoProto]:
            return [
                helper.make_tensor_value_info(
                    key, helper.np_dtype_to_tensor_dtype(np.dtype(kind)), shape
                )
                for key, (kind, shape) in tensors.items()
            ]

        model = helper.make_model(
            helper.make_graph(self.nodes, name, infos(inputs), infos(outputs), self.constants),
            producer_name="mjx_balance",
            producer_version=installed_version("mjx_balance") or "",
            doc_string=about,
            ir_version=IR_VERSION,
            opset_imports=[helper.make_opsetid("", OPSET)],
        )
        helper.set_model_props(model, {"manifest": json.dumps(manifest)})
        onnx.checker.check_model(model, full_check=True)
        return model

    def _constant(self, value: np.ndarray | np.floating) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name


def best_action(
    graph: Graph, out: str, factors: Sequence[int], radial: bool, output: str = ""
) -> str:
    """Index (N,) of the best action from the network's outputs (N, n), as `heads`' argmax."""
    if radial:
        zero, last = np.float32(0), np.asarray(factors, np.float32) - 1
        mu = graph.columns(out, 1, 1 + len(factors))
        at = graph.add("Mul", graph.add("Add", mu, np.float32(1)), last / 2)
        # ONNX leaves the cast of NaN undefined; NumPy's head chooses the first point.
        at = graph.add("Where", graph.add("IsNaN", at), zero, at)
        nearest = graph.add("Min", graph.add("Max", graph.add("Round", at), zero), last)
        digits = graph.add("Cast", nearest, to=TensorProto.INT64)
    else:
        best = [graph.add("ArgMax", x, axis=1) for x in _branches(graph, out, factors)]
        digits = graph.add("Concat", *best, axis=1)
    strides = [math.prod(factors[k + 1 :]) for k in range(len(factors))]
    index = graph.add("Mul", digits, np.asarray(strides))
    return graph.add("ReduceSum", index, np.asarray([1]), keepdims=0, output=output)


def best_point(graph: Graph, out: str, count: int) -> str:
    """The best point (N, count) within the grid's range, -1 to 1, as `heads.Radial.peak`."""
    low, high = np.float32(-1), np.float32(1)
    mu = graph.columns(out, 1, 1 + count)
    mu = graph.add("Where", graph.add("IsNaN", mu), low, mu)
    return graph.add("Min", graph.add("Max", mu, low), high)


def _branches(graph: Graph, out: str, factors: Sequence[int]) -> list[str]:
    """Values of the digits of every factor."""
    ends = np.cumsum(factors)
    return [graph.columns(out, end - n, end) for n, end in zip(factors, ends, strict=True)]


def _additive_values(graph: Graph, out: str, policy: Policy) -> str:
    """Values of all actions, as `heads.Additive`."""
    values, *others = _branches(graph, out, policy.factors)
    size = policy.factors[0]
    for branch, levels in zip(others, policy.factors[1:], strict=True):
        rows = graph.add("Unsqueeze", values, np.asarray([2]))
        table = graph.add("Add", rows, graph.add("Unsqueeze", branch, np.asarray([1])))
        size *= levels
        values = graph.add("Reshape", table, np.asarray([0, size]))
    return values


def _radial_values(graph: Graph, out: str, policy: Policy) -> str:
    """Values of all actions, as `heads.Radial`."""
    value = graph.columns(out, 0, 1)
    mu = graph.columns(out, 1, 1 + len(policy.factors))
    alpha, beta, kappa, delta = np.logaddexp(policy.profile, np.zeros_like(policy.profile))
    offset = graph.add("Sub", points(policy.factors), graph.add("Unsqueeze", mu, np.asarray([1])))
    scaled = graph.add("Mul", offset, np.exp(policy.stretch))
    squares = graph.add("ReduceSum", graph.add("Mul", scaled, scaled), np.asarray([2]), keepdims=0)
    z = graph.add("Sqrt", graph.add("Add", squares, delta**2))
    peak = graph.add("Mul", graph.add("Exp", graph.add("Mul", z, -beta)), alpha)
    return graph.add("Sub", graph.add("Add", value, peak), graph.add("Mul", z, kappa))
