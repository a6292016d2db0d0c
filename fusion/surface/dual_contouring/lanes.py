"""C++ that works on several cells or quads at once: the same source is vector instructions on the CPU, not on CUDA.

``V`` are floats, ``I`` ints and ``L`` 64-bit words, one in each lane; ``to_floats`` and ``to_ints`` convert them and
``lanes_of`` gives their lanes.
"""

ONE_LANE_IN_CPP = "using V = float;\n"
"""C++ for the top of a native function: numbers ``V`` of a single cell."""

LANES = 8

LANES_IN_CPP = f"""
#ifdef __CUDA_ARCH__
    constexpr int LANES = 1;
    using V = float;
    using I = int;
    using L = wp::uint64;
    auto to_floats = [](I x) {{ return (float)x; }};
    auto to_ints = [](L x) {{ return (int)(unsigned int)x; }};
#else
    constexpr int LANES = {LANES};
    typedef float V __attribute__((ext_vector_type(LANES)));
    typedef int I __attribute__((ext_vector_type(LANES)));
    typedef unsigned long long L __attribute__((ext_vector_type(LANES)));
    auto to_floats = [](I x) {{ return __builtin_convertvector(x, V); }};
    auto to_ints = [](L x) {{ return __builtin_convertvector(x, I); }};
#endif
    struct {{
        float *operator()(V &x) const {{ return (float *)&x; }}
        const float *operator()(const V &x) const {{ return (const float *)&x; }}
        wp::uint64 *operator()(L &x) const {{ return (wp::uint64 *)&x; }}
    }} lanes_of;
"""
"""C++ for the top of a native function: as many lanes as a vector instruction has, on CUDA one."""
