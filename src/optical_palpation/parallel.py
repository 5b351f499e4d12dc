"""Work on the rows of a grid, shared among the threads.

Numba's threads are launched by way of its lowering, most of which is not documented; without it
(:func:`~optical_palpation.runtime.environment.public_numba`) one thread does all rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, cast

import numba as nb
from llvmlite import ir
from llvmlite.binding import Linkage
from numba import extending
from numba.core import cgutils, types

from optical_palpation.errors import InputError
from optical_palpation.runtime.environment import check_environment, public_numba
from optical_palpation.runtime.kernels import keep_kernels

keep_kernels()

# By its own annotations callers would have to pass the typing context.
intrinsic: Any = extending.intrinsic


_launched_by: int | None = None


def launch_threads() -> None:
    """Launch numba's threads, which tells the linker where they are.

    Raises
    ------
    InputError
        If the environment variables of numba ask for what there is not.
    """
    global _launched_by
    if _launched_by is None:
        check_environment()
        try:
            nb.get_num_threads()
        except ValueError as error:  # such as a threading layer that is not installed
            raise InputError(
                f"numba cannot launch its threads ({error}); unset NUMBA_THREADING_LAYER"
            ) from error
        _launched_by = os.getpid()
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=_alone_after_fork)


def is_fork() -> bool:
    """Whether the process is the copy of one that had launched threads: it has none of them.

    Nor can it launch any, as far as GNU OpenMP goes. Kernels run on its only thread.
    """
    return _launched_by not in (None, os.getpid())


def _alone_after_fork() -> None:
    nb.set_num_threads(1)


def _keep_to_itself(library):
    """Let a library use its own copies of the functions that it calls.

    They are otherwise shared by name with those of libraries that were loaded earlier, which are
    optimised elsewhere and round otherwise: results would depend, in their last bits, on what has
    been compiled or loaded before.
    """
    optimise = library._optimize_final_module
    if optimise.__name__ == "alone":
        return

    def alone():
        for function in library._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.internal
        optimise()

    library._optimize_final_module = alone


@intrinsic
def in_parallel(typing_context, kernel, count, arguments):
    """Call kernel(*arguments, begin, end) on every thread, each for its part of range(count).

    Numba's own parallel loops run on the same threads, but of a loop's body they make three
    functions, each optimised with all that it calls: kernels would compile for twice as long.

    Raises
    ------
    MemoryError
        There was none for what the kernel allocates; kernels raise nothing else.
    """
    signature = kernel.get_call_type(typing_context, (*arguments, types.intp, types.intp), {})

    def generate(context, builder, _, values):
        compiled = kernel.dispatcher.overloads[signature.args]
        context.add_linking_libs([compiled.library])
        launch_threads()
        # also before the compiled kernel is loaded from the cache; not earlier, since a process
        # with threads cannot be forked
        context.active_code_library._reload_init.add(launch_threads)
        _keep_to_itself(context.active_code_library)
        byte, size = cgutils.voidptr_t, context.get_value_type(types.intp)
        zero, one = size(0), size(1)
        _, rows, given = values
        given = _borrowed(context, builder, arguments, given)
        task = ir.LiteralStructType([given.type, size, size, size])
        part = _part(context, builder, compiled.fndesc, signature, task)
        threads = builder.call(
            cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(size, []), "get_num_threads"
            ),
            [],
        )
        shared = cgutils.alloca_once(builder, task)
        for place, value in enumerate((given, rows, threads, zero)):
            builder.store(value, cgutils.gep_inbounds(builder, shared, 0, place))
        # Numba's threads advance through arrays: of one of bytes at address 0 the address is a
        # part's number.
        arrays, counts, steps = (cgutils.alloca_once(builder, kind) for kind in (byte, size, size))
        builder.store(cgutils.get_null_value(byte), arrays)
        builder.store(threads, counts)
        builder.store(one, steps)
        shared_bytes = builder.bitcast(shared, byte)
        alone = builder.icmp_signed("==", threads, one)
        with builder.if_else(alone) as (then, otherwise):
            with then:
                builder.call(part, [arrays, counts, steps, shared_bytes])
            with otherwise:
                launch = cgutils.get_or_insert_function(
                    builder.module,
                    ir.FunctionType(ir.VoidType(), [byte] * 5 + [size] * 3),
                    "numba_parallel_for",
                )
                pointers = [builder.bitcast(v, byte) for v in (part, arrays, counts, steps)]
                builder.call(launch, [*pointers, shared_bytes, zero, one, threads])
        failed = builder.load(cgutils.gep_inbounds(builder, shared, 0, 3))
        with cgutils.if_unlikely(builder, builder.icmp_signed("!=", failed, zero)):
            context.call_conv.return_user_exc(
                builder, MemoryError, ("no memory for the work arrays of a kernel",)
            )
        return context.get_dummy_value()

    return types.void(kernel, count, arguments), generate


def _borrowed(context, builder, kind, value):
    """Return the value without its arrays' reference counts, which threads would contend for."""
    if isinstance(kind, types.BaseTuple):
        for n, member in enumerate(cast(Iterable[types.Type], kind)):
            inside = _borrowed(context, builder, member, builder.extract_value(value, n))
            value = builder.insert_value(value, inside, n)
    elif isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        value = array._getvalue()
    return value


def _part(context, builder, description, signature, task):
    """Make the function, of the form that numba's threads call, that does some of the parts.

    ``task`` holds the arguments, the number of rows, that of parts, and whether one has failed.
    """
    byte, size = cgutils.voidptr_t, context.get_value_type(types.intp)
    kind = ir.FunctionType(
        ir.VoidType(), [byte.as_pointer(), size.as_pointer(), size.as_pointer(), byte]
    )
    name = builder.module.get_unique_name(f"{builder.function.name}.part")
    part = ir.Function(builder.module, kind, name)
    part.linkage = "internal"
    inner = ir.IRBuilder(part.append_basic_block())
    arrays, counts, _, shared = part.args
    shared = inner.bitcast(shared, task.as_pointer())
    arguments, rows, parts = (
        inner.load(cgutils.gep_inbounds(inner, shared, 0, n)) for n in range(3)
    )
    number = inner.ptrtoint(inner.load(arrays), size)
    past = inner.add(number, inner.load(counts))
    begin, end = (inner.sdiv(inner.mul(rows, n), parts) for n in (number, past))
    values = [inner.extract_value(arguments, n) for n in range(len(signature.args) - 2)]
    status, _ = context.call_internal_no_propagate(
        inner, description, signature, [*values, begin, end]
    )
    with inner.if_then(status.is_error, likely=False):
        inner.store(size(1), cgutils.gep_inbounds(inner, shared, 0, 3))
    inner.ret_void()
    return part


if public_numba():

    @nb.njit
    def in_parallel(kernel, count, arguments):
        """Call kernel(*arguments, 0, count) on this thread."""
        kernel(*arguments, 0, count)
