"""Compiles the Triton kernels for compute capabilities without a GPU: ``python triton_compile.py 89 90``.

The default field is compiled wholly for the newest capability. ``gradient``, whose products depend on the GPU, is also
lowered to the stage that has refused some: for the default field on the older capabilities, and for the largest and
the smallest field on the newest.
"""

import sys

import triton
from triton._C.libtriton import ir
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.compiler.compiler import make_backend

from instant_ic.vspace.config import FieldConfig
from instant_ic.vspace.nerf import triton_kernels
from instant_ic.vspace.nerf.triton_device import ENTRIES, TILE, TRAIN_BLOCK, kernel_shape

FIELD = kernel_shape(FieldConfig())
SMALLEST, LARGEST = FieldConfig(levels=1, hidden=4), FieldConfig(levels=16, hidden=32)
WHOLE = [
    (triton_kernels.sample_rays, {"B": TILE}),
    (triton_kernels.gradient, {**FIELD, "B": TRAIN_BLOCK}),
    (triton_kernels.adam_table, {"F": 4, "B": ENTRIES}),
    (triton_kernels.adam_network, {"COUNT": 1188, "B": 2048}),
]
NUMBERS = {
    "i32": "columns rows width height w h keyframes count size nx ny nz",
    "fp32": "cell panorama_share depth_share beta1 beta2 epsilon",
    "*u8": "rgb depth_edge usable known grid",
    "*i32": "sources",
    "*fp16": "half_table",
}
KINDS = {name: kind for kind, names in NUMBERS.items() for name in names.split()}


def kind_of(kernel, name, constants):
    if name in constants:
        return "constexpr"
    if name == "table" and kernel is not triton_kernels.adam_table:
        return "*fp16"  # as the others read it
    return KINDS.get(name, "*fp32")


def source_of(kernel, constants):
    signature = {name: kind_of(kernel, name, constants) for name in kernel.arg_names}
    aligned = [
        (number,)
        for number, (name, kind) in enumerate(signature.items())
        if kind.startswith("*") and name not in ("turn", "step_size")
    ]
    attributes = {place: [["tt.divisibility", 16]] for place in aligned}
    return ASTSource(fn=kernel, signature=signature, constexprs=constants, attrs=attributes)


def lower(source, target):
    """Compile up to the GPU's dialect, where layouts for the tensor cores are chosen: a third of the whole."""
    backend = make_backend(target)
    options = backend.parse_options({"num_warps": 4})
    context = ir.context()
    ir.load_dialects(context)
    backend.load_dialects(context)
    functions = backend.get_codegen_implementation(options)
    module = source.make_ir(target, options, functions, backend.get_module_map(), context)
    stages = {}
    backend.add_stages(stages, options, source.language)
    for stage in ("ttir", "ttgir"):
        module = stages[stage](module, dict(vars(options)))


def main(capabilities):
    targets = [GPUTarget("cuda", capability, 32) for capability in capabilities]
    fields = [*((FieldConfig(), target) for target in targets[:-1]), (SMALLEST, targets[-1]), (LARGEST, targets[-1])]
    for field, target in fields:
        lower(source_of(triton_kernels.gradient, {**kernel_shape(field), "B": TRAIN_BLOCK}), target)
        sys.stdout.write(f"ttgir gradient {target.arch} {field.levels}\n")
    lower(source_of(triton_kernels.render_rays, {**FIELD, "B": TILE}), targets[-1])  # 20 s to the end
    sys.stdout.write(f"ttgir render_rays {targets[-1].arch}\n")
    for kernel, constants in WHOLE:
        made = triton.compile(source_of(kernel, constants), target=targets[-1], options={"num_warps": 4})
        sys.stdout.write(f"cubin {kernel.fn.__name__} {len(made.asm['cubin'])}\n")


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]])
