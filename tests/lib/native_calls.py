"""Native functions compiled into loops over NumPy arrays, for tests and benchmarks."""

import ctypes

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

from lieint_jax.native.functions import FUNCTIONS, sincos

DOUBLE, FLOAT, INT = ir.DoubleType(), ir.FloatType(), ir.IntType(64)
EMITTERS = {**FUNCTIONS, "sincos": sincos}
INPUTS = {name: 2 if name in ("atan2", "pow") else 1 for name in EMITTERS}
OUTPUTS = {name: 2 if name == "sincos" else 1 for name in EMITTERS}


def define_loop(module, name, lanes, element):
    """Define `loop(count, in…, out…)`, which computes `lanes` numbers at a time; 0 lanes are scalars."""
    vector = ir.VectorType(element, lanes) if lanes else element
    pointers = [element.as_pointer()] * (INPUTS[name] + OUTPUTS[name])
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [INT, *pointers]), f"{name}.{lanes}.{element}")
    entry, body, done = (function.append_basic_block(label) for label in ("entry", "body", "done"))
    builder = ir.IRBuilder(entry)
    builder.branch(body)
    builder.position_at_end(body)
    index = builder.phi(INT)
    index.add_incoming(INT(0), entry)
    places = [
        builder.bitcast(builder.gep(argument, [index], source_etype=element), vector.as_pointer())
        for argument in function.args[1:]
    ]
    arguments = [builder.load(place, typ=vector, align=4) for place in places[: INPUTS[name]]]
    results = EMITTERS[name](builder, *arguments)
    for result, place in zip(results if OUTPUTS[name] == 2 else [results], places[INPUTS[name] :], strict=True):
        builder.store(result, place, align=4)
    following = builder.add(index, INT(lanes or 1))
    index.add_incoming(following, builder.block)
    builder.cbranch(builder.icmp_signed("<", following, function.args[0]), body, done)
    builder.position_at_end(done)
    builder.ret_void()
    return function.name


class NativeLoops:
    """One compiled module with a loop for each (name, lanes, element type)."""

    def __init__(self, keys, optimization=2):
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        module = ir.Module("loops")
        self.symbols = {key: define_loop(module, *key) for key in keys}
        features = llvm.get_host_cpu_features().flatten()
        target = llvm.Target.from_default_triple()
        self.machine = target.create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=features, opt=optimization, jit=True
        )
        self.module = llvm.parse_assembly(str(module))
        self.module.verify()
        options = llvm.create_pipeline_tuning_options(speed_level=optimization)
        options.loop_vectorization = options.slp_vectorization = False
        passes = llvm.create_pass_builder(self.machine, options)
        passes.getModulePassManager().run(self.module, passes)
        self.engine = llvm.create_mcjit_compiler(self.module, self.machine)
        self.engine.finalize_object()

    def native(self, key, arrays):
        """A call without arguments of one loop over arrays, inputs and then outputs, whose size the lanes divide."""
        pointers = [array.ctypes.data for array in arrays]
        signature = ctypes.CFUNCTYPE(None, ctypes.c_int64, *[ctypes.c_void_p] * len(pointers))
        loop = signature(self.engine.get_function_address(self.symbols[key]))
        return lambda: loop(len(arrays[0]), *pointers)

    def __call__(self, name, *arrays, lanes=8, element=DOUBLE):
        """The function of each entry; (sines, cosines) of `sincos`."""
        dtype = np.float64 if element == DOUBLE else np.float32
        size = len(arrays[0])
        inputs = [np.concatenate([a, np.full(-size % (lanes or 1), 0.5)]).astype(dtype) for a in arrays]
        outputs = [np.empty_like(inputs[0]) for _ in range(OUTPUTS[name])]
        self.native((name, lanes, element), [*inputs, *outputs])()
        results = tuple(output[:size] for output in outputs)
        return results if len(results) == 2 else results[0]
