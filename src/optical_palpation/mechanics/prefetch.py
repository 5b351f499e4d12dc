"""Asking for memory ahead of its use, which numba has no function for."""

from __future__ import annotations

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def prefetch(typing_context, array, index):
    """Ask the memory for the element ``index`` of a one-dimensional array, which need not exist."""

    def generate(context, builder, signature, arguments):
        there = context.make_array(signature.args[0])(context, builder, arguments[0])
        address = builder.gep(there.data, [arguments[1]])
        address = builder.bitcast(address, ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        # for reading, to be kept, data
        builder.call(function, [address, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, index), generate
