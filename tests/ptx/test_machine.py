"""The oracle itself: instructions by the law of NVIDIA's "PTX ISA", and what CUDA promises of memory and streams."""

import ctypes
import itertools
import math
import struct

import numpy as np
import pytest
import warp as wp

from ptx.compile import Kernel, Launch, Range, compiler, load
from ptx.operands import UnknownPtxError
from ptx.translate import to_c

_KINDS = {"f32": "f", "u32": "I", "s32": "i", "u64": "Q", "s64": "q", "f64": "d", "u16": "H", "s16": "h"}
NAN, INF = math.nan, math.inf
SUBNORMAL = 2.0**-140
TOLD = "selp.u32 %{0}, 1, 0, %p;"
LAWS = [
    ("fma.rn.f32 %{0}, %{1}, %{2}, %{3};", "f32", ["f32"] * 3, (1 + 2**-12, 1 + 2**-12, -1 - 2**-11), 2**-24),
    ("fma.rm.f32 %{0}, %{1}, %{2}, %{3};", "f32", ["f32"] * 3, (1.0, 1.0, -(2.0**-40)), 1 - 2**-24),
    ("mul.f32 %{0}, %{1}, %{2};", "f32", ["f32"] * 2, (1 + 2**-12, 1 + 2**-12), 1 + 2**-11),
    ("div.rn.f32 %{0}, %{1}, %{2};", "f32", ["f32"] * 2, (1.0, 3.0), float(np.float32(1) / np.float32(3))),
    ("min.f32 %{0}, %{1}, %{2};", "f32", ["f32"] * 2, (NAN, 2.0), 2.0),
    ("max.f32 %{0}, %{1}, %{2};", "f32", ["f32"] * 2, (-0.0, 0.0), 0.0),
    ("copysign.f32 %{0}, %{1}, %{2};", "f32", ["f32"] * 2, (-1.0, 3.0), -3.0),
    ("cvt.sat.f32.f32 %{0}, %{1};", "f32", ["f32"], (NAN,), 0.0),
    ("cvt.rmi.f32.f32 %{0}, %{1};", "f32", ["f32"], (-1.5,), -2.0),
    ("cvt.rzi.s32.f32 %{0}, %{1};", "s32", ["f32"], (NAN,), 0),
    ("cvt.rzi.s32.f32 %{0}, %{1};", "s32", ["f32"], (-3e9,), -(2**31)),
    ("cvt.rni.s32.f32 %{0}, %{1};", "s32", ["f32"], (2.5,), 2),
    ("cvt.rzi.u32.f32 %{0}, %{1};", "u32", ["f32"], (-7.0,), 0),
    ("cvt.rzi.u32.f32 %{0}, %{1};", "u32", ["f32"], (INF,), 2**32 - 1),
    ("cvt.rn.f32.u64 %{0}, %{1};", "f32", ["u64"], (2**64 - 1,), 2.0**64),
    ("cvt.s64.s32 %{0}, %{1};", "s64", ["s32"], (-5,), -5),
    ("div.s32 %{0}, %{1}, %{2};", "s32", ["s32"] * 2, (-7, 2), -3),
    ("rem.s32 %{0}, %{1}, %{2};", "s32", ["s32"] * 2, (-7, 2), -1),
    ("shl.b32 %{0}, %{1}, %{2};", "u32", ["u32"] * 2, (1, 32), 0),
    ("shr.s32 %{0}, %{1}, %{2};", "s32", ["s32", "u32"], (-8, 40), -1),
    ("mul.hi.u32 %{0}, %{1}, %{2};", "u32", ["u32"] * 2, (2**31, 6), 3),
    ("mul.wide.s32 %{0}, %{1}, %{2};", "s64", ["s32"] * 2, (-(2**31), 2), -(2**32)),
    ("mad.lo.s32 %{0}, %{1}, %{2}, %{3};", "s32", ["s32"] * 3, (2**31 - 1, 2, 3), 1),
    ("bfe.u32 %{0}, %{1}, %{2}, %{3};", "u32", ["u32"] * 3, (0xABCD1234, 8, 12), 0xD12),
    ("bfe.s32 %{0}, %{1}, %{2}, %{3};", "s32", ["s32", "u32", "u32"], (0x0000F000, 12, 4), -1),
    ("bfi.b32 %{0}, %{1}, %{2}, %{3}, %{4};", "u32", ["u32"] * 4, (0xF, 0, 28, 8), 0xF0000000),
    ("bfind.u32 %{0}, %{1};", "u32", ["u32"], (0,), 2**32 - 1),
    ("bfind.shiftamt.u32 %{0}, %{1};", "u32", ["u32"], (1,), 31),
    ("brev.b32 %{0}, %{1};", "u32", ["u32"], (1,), 2**31),
    ("popc.b64 %{0}, %{1};", "u32", ["u64"], (2**64 - 1,), 64),
    ("prmt.b32 %{0}, %{1}, %{2}, 33636;", "u32", ["u32"] * 2, (0x33221180, 0x77665544), 0xFF336644),
    ("lop3.b32 %{0}, %{1}, %{2}, %{3}, 150;", "u32", ["u32"] * 3, (0b1100, 0b1010, 0b1111), 0b1001),
    ("shf.l.wrap.b32 %{0}, %{1}, %{2}, 8;", "u32", ["u32"] * 2, (0x11223344, 0x55667788), 0x66778811),
    ("dp2a.lo.u32.u32 %{0}, %{1}, %{2}, %{3};", "u32", ["u32"] * 3, (0x00030002, 0x09080706, 5), 2 * 6 + 3 * 7 + 5),
    ("abs.s32 %{0}, %{1};", "s32", ["s32"], (-9,), 9),
    ("abs.ftz.f32 %{0}, %{1};", "f32", ["f32"], (-SUBNORMAL,), 0.0),
    ("neg.ftz.f32 %{0}, %{1};", "f32", ["f32"], (SUBNORMAL,), -0.0),
    ("max.ftz.f32 %{0}, %{1}, %{2};", "f32", ["f32"] * 2, (SUBNORMAL, -1.0), 0.0),
    ("max.f32 %{0}, %{1}, %{2};", "f32", ["f32"] * 2, (SUBNORMAL, -1.0), SUBNORMAL),
    ("cvt.rn.ftz.f32.f64 %{0}, %{1};", "f32", ["f64"], (SUBNORMAL,), 0.0),
    (".reg .pred %p;\nsetp.gt.ftz.f32 %p, %{1}, 0f00000000;\n" + TOLD, "u32", ["f32"], (SUBNORMAL,), 0),
    (".reg .pred %p;\nsetp.gt.f32 %p, %{1}, 0f00000000;\n" + TOLD, "u32", ["f32"], (SUBNORMAL,), 1),
]
AGES = itertools.count(1)
"""Of memory: instructions remember where their addresses lay."""
COMPARISONS = [("eq", 0), ("ne", 0), ("lt", 0), ("equ", 1), ("neu", 1), ("geu", 1), ("num", 0), ("nan", 1)]


@pytest.fixture(scope="module", autouse=True)
def _needs_a_compiler():
    if compiler() is None:
        pytest.skip("no C compiler")


def module_of(bodies):
    """Return a PTX module with a kernel for each body, which may write to the address %out."""
    head = ".version 8.0\n.target sm_90\n.address_size 64\n"
    kernels = [
        f".visible .entry k{i}_0_cuda_kernel_forward(\n.param .u64 p{i}\n)\n{{\n.reg .b64 %out;\n"
        f"ld.param.u64 %out, [p{i}];\n{body}\nret;\n}}\n"
        for i, body in enumerate(bodies)
    ]
    return head + "".join(kernels)


def run(library, number, count=8, block=1, ranges=None):
    """Run a kernel that writes to ``count`` bytes, and return these."""
    out = (ctypes.c_uint8 * count)()
    begin = ctypes.addressof(out)
    held = Range(begin, begin + count, 0) if ranges is None else ranges
    launch = Launch(block=block, ranges_count=1, ranges=ctypes.addressof(held), age=next(AGES))
    launch.grid[:] = (1, 1, 1)
    kernel = Kernel(library, f"k{number}_0_cuda_kernel_forward")
    pointer = ctypes.c_uint64(begin)
    kernel.run(launch, kernel.packed((ctypes.c_void_p * 1)(ctypes.addressof(pointer))))
    return bytes(out)


def test_instructions_do_what_the_isa_says(tmp_path):
    bodies = []
    for text, result, kinds, values, _ in LAWS:
        names = ["r", *(f"a{i}" for i in range(len(kinds)))]
        declared = [
            f".reg .{'b' + k[1:] if k[0] != 'f' else k} %{n};" for n, k in zip(names, [result, *kinds], strict=True)
        ]
        loads = [
            f"mov.b{kind[1:]} %{name}, {int.from_bytes(struct.pack('<' + _KINDS[kind], value), 'little')};"
            for name, kind, value in zip(names[1:], kinds, values, strict=True)
        ]
        bodies.append("\n".join([*declared, *loads, text.format(*names), f"st.global.{result} [%out], %r;"]))
    bodies += [
        f".reg .pred %p;\n.reg .b32 %r;\nsetp.{name}.f32 %p, 0f7FC00000, 0f3F800000;\n"
        "selp.u32 %r, 1, 0, %p;\nst.global.u32 [%out], %r;"
        for name, _ in COMPARISONS
    ]
    library = load(module_of(bodies), tmp_path, optimise=False)
    for number, (text, result, _, _, expected) in enumerate(LAWS):
        kind = _KINDS[result]
        found = struct.unpack_from("<" + kind, run(library, number))[0]
        assert found == expected, text
        assert math.copysign(1, found) == math.copysign(1, expected), text
    for number, (name, expected) in enumerate(COMPARISONS, start=len(LAWS)):
        assert run(library, number)[0] == expected, name


def test_what_is_not_known_is_named():
    for text in (
        "frobnicate.b32 %out, %out;",
        "add.rn.bf16 %out, %out, %out;",
        "ld.global.weird.u32 %out, [%out];",
        "prmt.b32.f4e %out, %out, %out, 0;",
        "min.NaN.f32 %out, %out, %out;",
        "abs.weird.f32 %out, %out;",
        "atom.global.add.noftz.u32 %out, [%out], 1;",
        "cvta.to.u64 %out, %out;",
    ):
        with pytest.raises(UnknownPtxError, match=r"PTX line \d+: " + text.split()[0]):
            to_c(module_of([text]))


def test_shared_memory_whose_size_a_launch_tells_is_not_put_where_other_memory_is():
    with pytest.raises(UnknownPtxError, match="held"):
        to_c(".extern .shared .align 16 .b8 held[];\n" + module_of(["mov.u64 %out, held;"]))


def test_threads_wait_for_each_other_and_wrong_ones_are_told(tmp_path):
    shared = (
        ".shared .align 4 .b8 held[256];\n.reg .b32 %t;\n.reg .b32 %a;\n.reg .b32 %v;\n.reg .b64 %o;\n.reg .pred %p;\n"
    )
    where = "mov.u32 %t, %tid.x;\nshl.b32 %a, %t, 2;\nmov.u32 %v, held;\nadd.u32 %a, %a, %v;\n"
    # Each takes what the thread after it has put there; the last takes the first's.
    turn = "st.shared.u32 [%a], %t;\nbar.sync 0;\nadd.u32 %t, %t, 1;\nand.b32 %t, %t, 63;\nshl.b32 %a, %t, 2;\n"
    turn += "add.u32 %a, %a, %v;\nld.shared.u32 %v, [%a];\nmov.u32 %t, %tid.x;\nmul.wide.u32 %o, %t, 4;\n"
    turn += "add.u64 %out, %out, %o;\nst.global.u32 [%out], %v;"
    vote = "mov.u32 %t, %tid.x;\nsetp.lt.u32 %p, %t, 5;\nvote.sync.ballot.b32 %v, %p, -1;\n"
    lonely = "mov.u32 %t, %tid.x;\nsetp.gt.u32 %p, %t, 20;\n@%p bra $out;\nvote.sync.ballot.b32 %v, %p, -1;\n$out:\n"
    bodies = [shared + where + turn, shared + vote + "st.global.u32 [%out], %v;", shared + lonely]
    library = load(module_of(bodies), tmp_path, optimise=False)
    taken = np.frombuffer(run(library, 0, count=256, block=64), np.uint32)
    np.testing.assert_array_equal(taken, (np.arange(64) + 1) % 64)
    assert run(library, 1, block=32)[0] == 0b11111
    with pytest.raises(RuntimeError, match="a vote waits for a thread that is not there"):
        run(library, 2, block=32)


def test_an_address_that_is_not_the_devices_is_told(tmp_path):
    body = ".reg .b32 %v;\nmov.u32 %v, 7;\nst.global.u32 [%out{offset}], %v;"
    library = load(module_of([body.format(offset=o) for o in ("+4", "+8", "+2")]), tmp_path, optimise=False)
    assert run(library, 0)[4] == 7
    with pytest.raises(RuntimeError, match=r"illegal address: 4 bytes .* PTX line"):
        run(library, 1)
    with pytest.raises(RuntimeError, match="misaligned address"):
        run(library, 2)


@wp.kernel(module="unique", enable_backward=False)
def _double(values: wp.array(dtype=float)):
    i = wp.tid()
    values[i] = 2.0 * values[i]


def test_a_pinned_buffer_that_is_filled_anew_too_early_spoils_the_copy(machine, cuda, monkeypatch):
    monkeypatch.setattr(machine.streams, "late", True)
    pinned = wp.full(4, 1.0, dtype=float, device="cpu", pinned=True)
    there = wp.zeros(4, dtype=float, device=cuda)
    for waits in (True, False):
        pinned.fill_(1.0)
        wp.copy(there, pinned)
        if waits:
            wp.synchronize_event(wp.get_stream(cuda).record_event())
        pinned.fill_(5.0)
        np.testing.assert_array_equal(there.numpy(), 1.0 if waits else 5.0)


def test_streams_wait_only_where_they_are_told_to(machine, cuda, monkeypatch):
    monkeypatch.setattr(machine.streams, "late", True)
    other, result = wp.Stream(cuda), wp.empty(4, dtype=float, device="cpu", pinned=True)
    for waits in (True, False):
        there = wp.full(4, 1.0, dtype=float, device=cuda)
        wp.synchronize_device(cuda)
        wp.launch(_double, dim=4, inputs=[there], device=cuda)
        if waits:
            other.wait_stream(wp.get_stream(cuda))
        wp.copy(result, there, stream=other)
        wp.synchronize_stream(other)
        np.testing.assert_array_equal(result.numpy(), 2.0 if waits else 1.0)


def test_host_code_cannot_read_the_devices_memory_and_new_memory_is_empty_of_sense(cuda):
    array = wp.empty(4, dtype=float, device=cuda)
    assert array.ptr >= 1 << 48
    assert (np.abs(array.numpy()) > 0).all()
    with pytest.raises(RuntimeError, match="cpu"):
        wp.launch(_double, dim=4, inputs=[array], device="cpu")
