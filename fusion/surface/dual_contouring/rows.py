"""C++ that finds voxels beside each other, across the borders of blocks."""

ROWS_IN_CPP = """
    // Where the layers z and z + 1 of the block and of those beyond begin: of corner x + 2 y + 4 z.
    size_t rows[8];
    for (int corner = 0; corner < 8; ++corner) {
        const int holder = cells.upper.data[8 * slot + ((corner & 3) | (z == 7 ? corner & 4 : 0))];
        const int number = holder < 0 || cells.numbers.shape[0] == 0 ? holder : cells.numbers.data[holder];
        rows[corner] = 512 * (size_t)(number < 0 ? 0 : number) + 64 * ((z + (corner >> 2)) & 7);
    }
"""
"""For a native function with ``cells``, ``slot`` and ``z``: looked up once for all voxels of a layer."""
