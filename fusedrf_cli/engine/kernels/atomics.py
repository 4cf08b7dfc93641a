"""Atomic sums of four neighbours at once, which newer GPUs do in one instruction instead of four."""

from llvmlite import ir
from numba.core import types
from numba.cuda import cgutils
from numba.cuda.core.targetconfig import ConfigStack
from numba.cuda.extending import intrinsic
from numba.cuda.np import arrayobj
from numba.cuda.nvvmutils import declare_atomic_add_float32, declare_atomic_add_float64


@intrinsic
def add_4(typingctx, out, o, e0, e1, e2, e3):
    """out[o : o + 4] += e0 .. e3, numbers of the array's type, where others may be adding too; o is a
    multiple of 4, and the array starts at one of 16 bytes."""

    def code(context, builder, signature, arguments):
        array_type = signature.args[0]
        array = arrayobj.make_array(array_type)(context, builder, arguments[0])
        start = cgutils.get_item_pointer(
            context, builder, array_type, array, [arguments[1]], wraparound=False, boundscheck=False
        )
        newer = ConfigStack().top().compute_capability >= (9, 0)  # has `red.v4.f32` (PTX ISA 8.1)
        if array_type.dtype == types.float32 and newer:
            vector = (
                "{ .reg .u64 at; cvta.to.global.u64 at, $0; red.global.add.v4.f32 [at], {$1, $2, $3, $4}; }"
            )
            kinds = ir.FunctionType(ir.VoidType(), [start.type, *[ir.FloatType()] * 4])
            add = ir.InlineAsm(kinds, vector, "l,f,f,f,f,~{memory}", side_effect=True)
            builder.call(add, [start, *arguments[2:]])
        else:
            single = array_type.dtype == types.float32
            add = declare_atomic_add_float32 if single else declare_atomic_add_float64
            for k, value in enumerate(arguments[2:]):
                place = builder.gep(start, [ir.Constant(ir.IntType(64), k)])
                builder.call(add(builder.module), (place, value))
        return context.get_dummy_value()

    number = out.dtype
    return types.none(out, o, number, number, number, number), code
