"""Compiles the Triton kernels for some compute capabilities, which needs no GPU: ``python triton_compile.py 89 90``.

All but ``draw`` wholly for the default field and the newest capability; ``gradient``, whose products depend on the GPU,
up to the stage that has refused some: for every corner of ``FieldConfig``, and for the older capabilities.
"""

import itertools
import sys
from contextlib import suppress

import triton
from triton._C.libtriton import ir
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.compiler.compiler import make_backend

from instant_ic.vspace.config import FieldConfig
from instant_ic.vspace.nerf import triton_kernels
from instant_ic.vspace.nerf.triton_device import ENTRIES, TILE, TRAIN_BLOCK, kernel_shape

FIELD = kernel_shape(FieldConfig())
KERNELS = [
    (triton_kernels.sample_rays, {"B": TILE}),
    (triton_kernels.gradient, {**FIELD, "B": TRAIN_BLOCK}),
    (triton_kernels.adam_table, {"F": 4, "B": ENTRIES}),
    (triton_kernels.adam_network, {"COUNT": 1188, "B": 2048}),
    (triton_kernels.draw, {**FIELD, "B": TILE}),
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


def corners():
    """Smallest and largest sizes that ``FieldConfig`` allows, found by asking it."""
    for features in (2, 4):
        allowed = []
        for levels, hidden in itertools.product(range(1, 65), range(4, 257, 4)):
            with suppress(ValueError):
                allowed.append(FieldConfig(levels=levels, features=features, hidden=hidden))
        levels = {end(field.levels for field in allowed) for end in (min, max)}
        hidden = {end(field.hidden for field in allowed) for end in (min, max)}
        for pair in itertools.product(levels, hidden):
            yield FieldConfig(levels=pair[0], features=features, hidden=pair[1])


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
    targets = {capability: GPUTarget("cuda", capability, 32) for capability in capabilities}
    newest = capabilities[-1]
    # Every corner for the newest, which alone has refused some; the default field for all.
    for capability, fields in {**{one: [FieldConfig()] for one in capabilities}, newest: corners()}.items():
        for field in fields:
            source = source_of(triton_kernels.gradient, {**kernel_shape(field), "B": TRAIN_BLOCK})
            lower(source, targets[capability])
            sys.stdout.write(f"ttgir gradient {capability} {field.levels} {field.features} {field.hidden}\n")
    for kernel, constants in KERNELS:
        source = source_of(kernel, constants)
        if kernel is triton_kernels.draw:  # takes 20 s to the end and has no product that `gradient` has not
            lower(source, targets[newest])
            sys.stdout.write(f"ttgir draw {newest}\n")
        else:
            made = triton.compile(source, target=targets[newest], options={"num_warps": 4})
            sys.stdout.write(f"cubin {kernel.fn.__name__} {newest} {len(made.asm['cubin'])}\n")


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]])
