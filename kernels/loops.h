// Loops of the CPU kernels over `range`. Warp's own is 16 bytes large, so a call hands it back in two registers, and
// LLVM then packs and unpacks them at every turn: 12 cycles of a loop that does nothing. A larger one comes back in
// memory, which LLVM sees through: 1 to 2 cycles. Read before Warp's code for a CPU (`maexp.kernels.startup`).
#pragma once
#define WP_TILE_BLOCK_DIM 1
#define WP_NO_CRT
#include "builtin.h"

namespace wp {

struct wide_range_t {
    int start, end, step, i;
    long long more_than_two_registers;
};

inline wide_range_t wide_range(int start, int end, int step) { return {start, end, step, start, 0}; }
inline wide_range_t wide_range(int start, int end) { return wide_range(start, end, 1); }
inline wide_range_t wide_range(int end) { return wide_range(0, end, 1); }

inline int iter_next(wide_range_t& r)
{
    int i = r.i;
    r.i += r.step;
    return i;
}

inline bool iter_cmp(const wide_range_t& r) { return r.step > 0 ? r.i < r.end : r.step < 0 && r.i > r.end; }

}  // namespace wp

#define range_t wide_range_t
#define range wide_range
