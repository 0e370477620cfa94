"""Evaluates CasADi functions on batches of NumPy arrays, without copies into CasADi's matrices."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.planning.kinematics.machine_code import MachineCode
from vkc_pin.utils.arrays import Floats

_MAX_BUFFERS = 16  # batch sizes with cached buffers
_BATCH_MULTIPLE = 16  # batch sizes are rounded up to multiples of this
# Executed instructions (20 ms) after which machine code of a function is requested.
_MIN_INSTRUCTIONS_TO_COMPILE = 2_000_000
_BYTES_PER_INSTRUCTION = 70  # measured on waypoint functions


class BatchFunction:
    """Evaluates a function of dense columns for many rows at once.

    Attributes:
        function: CasADi function; its inputs are columns, its outputs dense.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._buffers: OrderedDict[int, tuple[Any, Any, list[Floats], list[Floats]]] = OrderedDict()
        self._code = MachineCode(function)
        self._instructions = function.n_instructions()
        self._executed_instructions = 0  # since machine code was last requested

    def __call__(self, *inputs: Floats) -> list[Floats]:
        """Return one array per output, shape (B, numel), each row in column-major order.

        Args:
            inputs: One array per input. The first has shape (B, numel), the others shape (B, numel)
                or (numel,), which applies to all rows.
        """
        rows = len(inputs[0])
        self._executed_instructions += rows * self._instructions
        is_frequent = self._executed_instructions > _MIN_INSTRUCTIONS_TO_COMPILE
        if is_frequent and not self._code.is_compiled:
            self._executed_instructions = 0
            if self._code.try_load():
                self._buffers.clear()
        multiples = max(-(-rows // _BATCH_MULTIPLE), 1)  # rounded up
        batch_size = multiples * _BATCH_MULTIPLE
        if batch_size not in self._buffers:
            self._allocate(batch_size)
        self._buffers.move_to_end(batch_size)
        _, trigger, arguments, results = self._buffers[batch_size]
        for argument, values in zip(arguments, inputs, strict=True):
            argument[:rows] = values
        trigger()
        return [result[:rows].copy() for result in results]

    def _allocate(self, batch_size: int) -> None:
        """Allocate arrays that CasADi reads and writes, for one batch size."""
        (function,) = self._code.functions
        buffer, trigger = function.map(batch_size).buffer()
        arguments = []
        for index in range(self.function.n_in()):
            argument = np.zeros((batch_size, self.function.nnz_in(index)))
            buffer.set_arg(index, argument.data)
            arguments.append(argument)
        results = []
        for index in range(self.function.n_out()):
            result = np.zeros((batch_size, self.function.nnz_out(index)))
            buffer.set_res(index, result.data)
            results.append(result)
        self._buffers[batch_size] = (buffer, trigger, arguments, results)
        while len(self._buffers) > _MAX_BUFFERS:
            self._buffers.popitem(last=False)

    @property
    def nbytes(self) -> int:
        """Estimated size in memory [bytes]."""
        size = estimate_size(self.function)
        for _, _, arguments, results in self._buffers.values():
            size += sum(array.nbytes for array in (*arguments, *results))
        return size


def estimate_size(*functions: ca.Function) -> int:
    """Return the estimated size of functions in memory [bytes]."""
    return _BYTES_PER_INSTRUCTION * sum(function.n_instructions() for function in functions)
