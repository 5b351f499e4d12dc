"""Instructions of the processor, and a product of BLAS, that numba has no function for.

They are made by way of numba's lowering, most of which is not documented; without it
(:func:`~optical_palpation.runtime.environment.public_numba`) loops stand in for them.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types

from optical_palpation.runtime.environment import public_numba

from .lanes import L

# By its own annotations callers would have to pass the typing context.
intrinsic: Any = extending.intrinsic


def _address(context, builder, kind, array, index):
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


@intrinsic
def prefetch(typing_context, array, index):
    """Ask the memory for the element ``index`` of a one-dimensional array, which need not exist."""

    def generate(context, builder, signature, arguments):
        address = _address(context, builder, signature.args[0], *arguments)
        address = builder.bitcast(address, ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        # for reading, to be kept, data
        builder.call(function, [address, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, index), generate


@intrinsic
def add_lanes(typing_context, target, first, source, start):
    """Add source[start : start + L] to target[first : first + L]; both one-dimensional.

    A loop over so few elements would become single additions: the compiler cannot know that the
    arrays do not overlap.
    """

    def generate(context, builder, signature, arguments):
        kind = ir.VectorType(context.get_value_type(target.dtype), L)
        size = context.get_abi_sizeof(context.get_value_type(target.dtype))
        there, here = (
            builder.bitcast(
                _address(context, builder, signature.args[n], arguments[n], arguments[n + 1]),
                kind.as_pointer(),
            )
            for n in (0, 2)
        )
        total = builder.fadd(builder.load(there, align=size), builder.load(here, align=size))
        builder.store(total, there, align=size)
        return context.get_dummy_value()

    return types.void(target, first, source, start), generate


@intrinsic
def subtract_matrix_product(typing_context, c, a, b):
    """Subtract a @ b from c, all single or all double; rows are contiguous, a and b are whole.

    ``np.dot`` would leave the product in an array of its own, which passes through the memory.
    """

    def generate(context, builder, signature, arguments):
        c, a, b = (
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        (m, n), (_, k) = (cgutils.unpack_tuple(builder, array.shape, 2) for array in (c, a))
        rows = cgutils.unpack_tuple(builder, c.strides, 2)[0]
        kind = signature.args[0].dtype
        char, whole, real = ir.IntType(8), m.type, context.get_value_type(kind)
        pitch = builder.sdiv(rows, whole(kind.bitwidth // 8))
        address = char.as_pointer()
        alpha, beta = (cgutils.alloca_once_value(builder, real(value)) for value in (-1.0, 1.0))
        alpha, beta, to, left, right = (
            builder.bitcast(at, address) for at in (alpha, beta, c.data, a.data, b.data)
        )
        kinds = [char] * 3 + [whole] * 3 + [address, address, whole, address, whole]
        function = ir.FunctionType(ir.IntType(32), [*kinds, address, address, whole])
        gemm = cgutils.get_or_insert_function(builder.module, function, "numba_xxgemm")
        precision, plain = char(ord("s" if kind == types.float32 else "d")), char(ord("n"))
        # BLAS has columns where these have rows: it takes the transposed product
        sizes = [precision, plain, plain, n, m, k]
        builder.call(gemm, [*sizes, alpha, right, n, left, k, beta, to, pitch])
        return context.get_dummy_value()

    return types.void(c, a, b), generate


if public_numba():

    @nb.njit
    def prefetch(array, index):
        """Do nothing: the processor asks for the memory itself."""

    @nb.njit
    def add_lanes(target, first, source, start):
        """Add source[start : start + L] to target[first : first + L]."""
        for lane in range(L):
            target[first + lane] += source[start + lane]

    @nb.njit
    def subtract_matrix_product(c, a, b):
        """Subtract a @ b from c."""
        c -= np.dot(a, b)
