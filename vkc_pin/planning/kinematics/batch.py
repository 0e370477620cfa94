"""CasADi functions on batches of NumPy arrays, without copying through CasADi's own matrices."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.planning.kinematics.machine_code import MachineCode
from vkc_pin.utils.arrays import Floats

__all__ = ["BatchFunction", "estimate_size"]

_KEPT = 16  # batch sizes whose buffers are kept
_ROUND = 16  # they are multiples of this
# instructions, 20 ms, after which a function is used enough to be asked for as machine code
_WORTH = 2_000_000
_INSTRUCTION = (
    70  # [bytes] that each instruction of a function takes, measured on those of waypoints
)


class BatchFunction:
    """Evaluates a function of dense columns for many rows at once.

    Attributes:
        function: The CasADi function; its inputs are columns, its outputs dense.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._buffers: OrderedDict[int, tuple[Any, Any, list[Floats], list[Floats]]] = OrderedDict()
        self._code, self._instructions, self._worked = (
            MachineCode(function),
            function.n_instructions(),
            0,
        )

    def __call__(self, *inputs: Floats) -> list[Floats]:
        """Return one array per output, shape (B, numel), entries column by column.

        Args:
            inputs: One array per input: the first of shape (B, numel), others too, or (numel,) for
                the same in every row.
        """
        rows = len(inputs[0])
        self._worked += rows * self._instructions
        if self._worked > _WORTH and not self._code.compiled:
            self._worked = 0
            if self._code.look():
                self._buffers.clear()
        batch = max(-(-rows // _ROUND), 1) * _ROUND
        if batch not in self._buffers:
            self._allocate(batch)
        self._buffers.move_to_end(batch)
        _, trigger, arguments, results = self._buffers[batch]
        for argument, values in zip(arguments, inputs, strict=True):
            argument[:rows] = values
        trigger()
        return [result[:rows].copy() for result in results]

    def _allocate(self, batch: int) -> None:
        mapped = self._code.functions[0].map(batch)
        buffer, trigger = mapped.buffer()
        arguments = [
            np.zeros((batch, self.function.nnz_in(i))) for i in range(self.function.n_in())
        ]
        results = [
            np.zeros((batch, self.function.nnz_out(i))) for i in range(self.function.n_out())
        ]
        for index, argument in enumerate(arguments):
            buffer.set_arg(index, argument.data)
        for index, result in enumerate(results):
            buffer.set_res(index, result.data)
        self._buffers[batch] = (buffer, trigger, arguments, results)
        while len(self._buffers) > _KEPT:
            self._buffers.popitem(last=False)

    @property
    def nbytes(self) -> int:
        """Its size in memory, estimated [bytes]."""
        buffers = (
            array.nbytes
            for *_, inputs, outputs in self._buffers.values()
            for array in (*inputs, *outputs)
        )
        return estimate_size(self.function) + sum(buffers)


def estimate_size(*functions: ca.Function) -> int:
    """Return the size of functions in memory, estimated [bytes]."""
    return _INSTRUCTION * sum(function.n_instructions() for function in functions)
