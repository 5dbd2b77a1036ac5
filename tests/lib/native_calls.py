"""Native functions compiled into loops over NumPy arrays, for tests and benchmarks."""

import ctypes

import llvmlite.binding as llvm
import numpy as np

from lieint_jax.native.functions import FUNCTIONS, Functions

DOUBLE, FLOAT = "double", "float"
INPUTS = {name: 2 if name in ("atan2", "pow") else 1 for name in FUNCTIONS}
OUTPUTS = {name: 2 if name == "sincos" else 1 for name in FUNCTIONS}
LOOP = """
declare {result} @{function}({types})
define void @loop.{function}(i64 %count, {pointers}) {{
entry:
  br label %body
body:
  %index = phi i64 [ 0, %entry ], [ %next, %body ]
{lines}
  %next = add i64 %index, {step}
  %more = icmp slt i64 %next, %count
  br i1 %more, label %body, label %done
done:
  ret void
}}
"""


def loop_text(functions, name, lanes, element):
    """`loop.FUNCTION(count, in…, out…)`, which computes `lanes` numbers at a time; 0 lanes are scalars."""
    inputs, outputs = INPUTS[name], OUTPUTS[name]
    function = functions.name(name, element, lanes, inputs)
    kind = f"<{lanes} x {element}>" if lanes else element
    result = f"{{ {kind}, {kind} }}" if outputs == 2 else kind
    lines = [f"%at{k} = getelementptr {element}, ptr %p{k}, i64 %index" for k in range(inputs + outputs)]
    lines += [f"%x{k} = load {kind}, ptr %at{k}, align 4" for k in range(inputs)]
    lines += [f"%found = call {result} @{function}({', '.join(f'{kind} %x{k}' for k in range(inputs))})"]
    for k in range(outputs):
        if outputs == 2:
            lines += [f"%y{k} = extractvalue {result} %found, {k}"]
        lines += [f"store {kind} {f'%y{k}' if outputs == 2 else '%found'}, ptr %at{inputs + k}, align 4"]
    return LOOP.format(
        function=function,
        result=result,
        types=", ".join([kind] * inputs),
        pointers=", ".join(f"ptr %p{k}" for k in range(inputs + outputs)),
        lines="\n".join(lines),
        step=lanes or 1,
    )


class NativeLoops:
    """One compiled module with a loop for each (name, lanes, element type)."""

    def __init__(self, keys, optimization=2):
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        functions = Functions()
        loops = [loop_text(functions, *key) for key in keys]
        features = llvm.get_host_cpu_features().flatten()
        target = llvm.Target.from_default_triple()
        self.machine = target.create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=features, opt=optimization, jit=True
        )
        self.module = llvm.parse_assembly("\n".join(loops))
        self.module.link_in(llvm.parse_assembly(functions.text()))
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
        name, lanes, element = key
        loop = signature(self.engine.get_function_address(f"loop.{name}.{element}.{lanes}"))
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
