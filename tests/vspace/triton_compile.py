"""Compiles all Triton kernels for some compute capabilities, which needs no GPU: ``python triton_compile.py 89 90``."""

import sys

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from instant_ic.vspace.nerf import triton_kernels
from instant_ic.vspace.nerf.triton_device import ENTRIES, TILE, TRAIN_BLOCK

FIELD = {"LEVELS": 8, "LP": 8, "F": 4, "HIDDEN": 32, "HP": 32}
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


def main(capabilities):
    for kernel, constants in KERNELS:
        signature = {name: kind_of(kernel, name, constants) for name in kernel.arg_names}
        aligned = [
            (number,)
            for number, (name, kind) in enumerate(signature.items())
            if kind.startswith("*") and name not in ("turn", "step_size")
        ]
        source = ASTSource(
            fn=kernel,
            signature=signature,
            constexprs=constants,
            attrs={place: [["tt.divisibility", 16]] for place in aligned},
        )
        for capability in capabilities:
            made = triton.compile(source, target=GPUTarget("cuda", capability, 32), options={"num_warps": 4})
            sys.stdout.write(f"{kernel.fn.__name__} {capability} {len(made.asm['cubin'])}\n")


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]])
