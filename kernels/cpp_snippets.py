"""What kernels do in C++: all of it stands here, each piece beside the function that kernels call.

Warp's Python has no pointers and no constants beyond 2^63. Where it takes twice as long, this is used. Warp's debug
mode does not look at pointers, but it heeds `assert`.
"""

import warp as wp

from maexp.kernels.constants import (
    BLOCKED,
    DIAGONAL,
    OBSTACLE,
    RAYS,
    STRAIGHT,
    TIGHT,
    TIGHT_FACTOR,
    UNKNOWN,
    UNREACHED,
)

BUCKETS = 64  # more than half the most that a step may add to a key, and a power of two
LAST_BUCKET = BUCKETS - 1
UNTOLD_BLOCK = 64  # points of which it is asked at once whether one is news
TELLING_WORDS = 8  # of radios, among whom news is looked for; of others all may be some
LOOK_CELLS = 5  # how far the nearest obstacle is looked for, in cells


# The finaliser of splitmix64 (Steele et al. 2014): constants of Warp end below 2^63.
UNIFORM = """
    const wp::int32 parts[5] = {seed, env_id, episode, macro_step, index};
    wp::uint64 key = 0;
    for (int k = 0; k < 5; ++k)
    {
        key += (wp::uint64)(wp::int64)parts[k] + 0x9E3779B97F4A7C15ull;
        key = (key ^ (key >> 30)) * 0xBF58476D1CE4E5B9ull;
        key = (key ^ (key >> 27)) * 0x94D049BB133111EBull;
        key = key ^ (key >> 31);
    }
    return (key >> 40) / 16777216.0f;
"""


@wp.func_native(UNIFORM)
def keyed_uniform(seed: int, env_id: int, episode: int, macro_step: int, index: int) -> float:
    """A number in [0, 1)."""
    ...


# Half the time of the same in Warp's Python, most of which goes to looking at eight neighbours. Rows of cells
# have no gaps.
SEARCH = f"""
    const int cells = w * h;
    const wp::uint8* state = &wp::index(passable, row, 0);
    int* label = &wp::index(distance, item, 0);
    int* labelled = &wp::index(touched, item, 0);
    int* after = &wp::index(next, place, 0);
    int* before = &wp::index(previous, place, 0);
    assert(cells <= passable.shape[1] && cells <= distance.shape[1]);
    assert(cells <= next.shape[1] && cells <= previous.shape[1]);
    assert(labelled[0] >= 0 && labelled[1] < distance.shape[1]);

    auto search = [&](auto left)  // the least that may be left from a cell to the goal
    {{
        int bucket[{BUCKETS}];
        int waiting = 0, key = {UNREACHED}, limit = 2147483646, lowest = cells, highest = -1;

        auto lower = [&](int cell, int x, int y, int value)  // and move the cell to the bucket of its key
        {{
            assert(x >= 0 && x < w && y >= 0 && y < h && cell == y * w + x);
            const int old = label[cell];
            if (value >= old) return;
            label[cell] = value;
            const int rest = left(x, y);
            if (old < {UNREACHED})
            {{
                const int ahead = after[cell], behind = before[cell];
                if (behind < 0) bucket[((old + rest) >> 1) & {LAST_BUCKET}] = ahead; else after[behind] = ahead;
                if (ahead >= 0) before[ahead] = behind;
            }}
            else ++waiting;
            int& head = bucket[((value + rest) >> 1) & {LAST_BUCKET}];
            after[cell] = head;
            before[cell] = -1;
            if (head >= 0) before[head] = cell;
            head = cell;
        }};
        auto visit = [&](int cell, int x, int y, int value, int weight)
        {{
            lower(cell, x, y, value + (state[cell] == {TIGHT} ? {TIGHT_FACTOR} * weight : weight));
        }};

        for (int k = 0; k < {BUCKETS}; ++k) bucket[k] = -1;
        for (int k = 0; k < sources.shape[1]; ++k)
        {{
            const int source = wp::index(sources, item, k);
            if (source < 0 || source >= cells || state[source] == {BLOCKED}) continue;
            const int y = source / w, x = source - y * w;
            lower(source, x, y, 0);
            key = wp::min(key, left(x, y));
            lowest = wp::min(lowest, source);
            highest = wp::max(highest, source);
        }}
        while (waiting > 0 && key <= limit)
        {{
            int& head = bucket[(key >> 1) & {LAST_BUCKET}];
            const int cell = head;
            if (cell < 0) {{ key += 2; continue; }}
            const int d = label[cell], y = cell / w, x = cell - y * w;
            head = after[cell];
            if (head >= 0) before[head] = -1;
            --waiting;
            lowest = wp::min(lowest, cell);
            highest = wp::max(highest, cell);
            if (cell == goal) limit = d;
            const bool east = x + 1 < w && state[cell + 1] != {BLOCKED}, west = x > 0 && state[cell - 1] != {BLOCKED};
            if (east) visit(cell + 1, x + 1, y, d, {STRAIGHT});
            if (west) visit(cell - 1, x - 1, y, d, {STRAIGHT});
            auto pass = [&](int beside, int v)
            {{
                if (state[beside] == {BLOCKED}) return;
                visit(beside, x, v, d, {STRAIGHT});
                if (east && state[beside + 1] != {BLOCKED}) visit(beside + 1, x + 1, v, d, {DIAGONAL});
                if (west && state[beside - 1] != {BLOCKED}) visit(beside - 1, x - 1, v, d, {DIAGONAL});
            }};
            if (y + 1 < h) pass(cell + w, y + 1);
            if (y > 0) pass(cell - w, y - 1);
        }}
        // Labels lie at most one row and one column beyond the cells that were left.
        labelled[0] = wp::max(lowest - w - 1, 0);
        labelled[1] = wp::min(highest + w + 1, cells - 1);
    }};

    for (int cell = labelled[0]; cell <= labelled[1]; ++cell) label[cell] = {UNREACHED};
    if (goal < 0) search([](int, int) {{ return 0; }});
    else
    {{
        const int goal_y = goal / w, goal_x = goal - goal_y * w;
        search([=](int x, int y)
        {{
            const int dx = wp::abs(x - goal_x), dy = wp::abs(y - goal_y);
            return {STRAIGHT} * wp::max(dx, dy) + {DIAGONAL - STRAIGHT} * wp::min(dx, dy);
        }});
    }}
"""


@wp.func_native(SEARCH)
def search_from(
    passable: wp.array2d(dtype=wp.uint8),
    row: int,
    sources: wp.array2d(dtype=wp.int32),
    item: int,
    goal: int,
    place: int,
    w: int,
    h: int,
    next: wp.array2d(dtype=wp.int32),
    previous: wp.array2d(dtype=wp.int32),
    touched: wp.array2d(dtype=wp.int32),
    distance: wp.array2d(dtype=wp.int32),
):
    """Distances of all cells, or of the ways to `goal`; those of the search before are cleared."""
    ...


# Half the time, as of `SEARCH`. It relies on rows of cells without gaps.
LOOK_FROM = f"""
    const wp::uint8* state = &wp::index(known, row, 0);
    float weight[3] = {{}};
    weight[{UNKNOWN}] = 1.0f;
    const int x = cell % w, y = cell / w;
    const bool inside = x >= reach && x + reach < w && y >= reach && y + reach < h;
    int low_x = x, low_y = y, high_x = x, high_y = y;
    float total = 0.0f, moment_x = 0.0f, moment_y = 0.0f;
    for (int ray = 0; ray < {RAYS}; ++ray)
    {{
        const wp::vec2i* to = &wp::index(ray_cell, ray, 0);
        const wp::vec3* part = &wp::index(ray_part, ray, 0);
        int u = x, v = y;
        for (int step = 1; step <= reach; ++step)
        {{
            const int next_u = x + to[step][0], next_v = y + to[step][1];
            if (!inside && (next_u < 0 || next_u >= w || next_v < 0 || next_v >= h)) break;
            // Not between two walls that touch at a corner either; of a straight step these are its two ends.
            const int there = state[next_v * w + next_u], left = state[next_v * w + u], right = state[v * w + next_u];
            u = next_u;
            v = next_v;
            if (there == {OBSTACLE} || (left == {OBSTACLE} & right == {OBSTACLE})) break;
            // Products with 1 and 0 are exact, and quicker than a branch that nobody can foresee.
            const float counts = weight[there], share = counts * part[step][0];
            const float far_x = counts * part[step][1], far_y = counts * part[step][2];
            total += share;
            moment_x += far_x;
            moment_y += far_y;
        }}
        low_x = u < low_x ? u : low_x;
        low_y = v < low_y ? v : low_y;
        high_x = u > high_x ? u : high_x;
        high_y = v > high_y ? v : high_y;
    }}
    wp::vec_t<5, wp::float64> found;
    found[0] = total;
    found[1] = moment_x;
    found[2] = moment_y;
    found[3] = low_y * w + low_x;
    found[4] = high_y * w + high_x;
    return found;
"""

found_from = wp.types.vector(length=5, dtype=wp.float64)


@wp.func_native(LOOK_FROM)
def see_cells(
    known: wp.array2d(dtype=wp.uint8),
    row: int,
    cell: int,
    w: int,
    h: int,
    reach: int,
    ray_cell: wp.array2d(dtype=wp.vec2i),
    ray_part: wp.array2d(dtype=wp.vec3),
) -> found_from:
    """Unknown cells in sight, the sum of the ways there, and the corners of what was looked at."""
    ...


# From the place's own row outwards, until rows lie farther than what was found. In each row of the bitmap the
# obstacles next to the place, one to either side, are the nearest. The least root is that of the least square.
NEAREST_WALL = f"""
    const int x = (int)wp::floor(p[0]), y = (int)wp::floor(p[1]);
    const int first = wp::max(x - {LOOK_CELLS}, 0), last = wp::min(x + {LOOK_CELLS}, w - 1);
    if (first > last) return {LOOK_CELLS}.0f;
    const int begin = wp::max(x, 0), low = first / 32, shift = first % 32, more = last / 32 - low;
    const unsigned window = (1u << (last - first + 1)) - 1u, below = (1u << (begin - first)) - 1u;
    const int* word = &wp::index(walls, row, low);
    assert((h - 1) * words + low + more < walls.shape[1]);
    float nearest = {LOOK_CELLS * LOOK_CELLS}.0f;
    auto look = [&](int v)  // at a row; whether those beyond it may be nearer
    {{
        const float dy = (float)v + 0.5f - p[1];
        if (dy * dy >= nearest) return false;
        if (v < 0 || v >= h) return true;
        unsigned bits = unsigned(word[v * words]) >> shift;
        if (more) bits |= unsigned(word[v * words + 1]) << (32 - shift);
        bits &= window;
        if (bits == 0u) return true;
        const unsigned right = bits >> (begin - first);
        unsigned left = bits & below;
        left |= left >> 1; left |= left >> 2; left |= left >> 4;  // down from its highest bit, of {LOOK_CELLS} at most
        const int behind = left ? first + wp::bit_count(left) - 1 : -{4 * LOOK_CELLS};
        const int ahead = begin + wp::bit_count((right & (0u - right)) - 1u);  // 32 cells away where there is none
        const wp::vec2 a((float)ahead + 0.5f - p[0], dy), b((float)behind + 0.5f - p[0], dy);
        nearest = wp::min(nearest, wp::min(wp::dot(a, a), wp::dot(b, b)));
        return true;
    }};
    for (int k = 0; k <= {LOOK_CELLS} && look(y - k); ++k);
    for (int k = 1; k <= {LOOK_CELLS} && look(y + k); ++k);
    return wp::sqrt(nearest);
"""


@wp.func_native(NEAREST_WALL)
def nearest_wall(walls: wp.array2d(dtype=wp.int32), row: int, p: wp.vec2, w: int, h: int, words: int) -> float:
    """Distance in cells from a place to the nearest obstacle cell's centre, `LOOK_CELLS` at most."""
    ...


# The words of a row at once.
HAS_WALL = """
    const wp::uint32* words = (const wp::uint32*)&wp::index(walls, row, line);
    const int low = first / 32, high = last / 32;
    const wp::uint32 from = ~0u << (first % 32), to = ~0u >> (31 - last % 32);
    if (low == high) return (words[low] & from & to) != 0;
    wp::uint32 found = (words[low] & from) | (words[high] & to);
    for (int word = low + 1; word < high; ++word) found |= words[word];
    return found != 0;
"""


@wp.func_native(HAS_WALL)
def has_wall(walls: wp.array2d(dtype=wp.int32), row: int, line: int, first: int, last: int) -> bool:
    """Whether a row of cells, whose words begin at `line`, holds a known obstacle from `first` to `last`."""
    ...


# Many at once.
COUNT_NONZERO = """
    const wp::uint8* value = &wp::index(values, row, 0);
    assert(end <= values.shape[1]);
    int found = 0;
    if (lanes == 1) for (int k = 0; k < end; ++k) found += value[k] != 0;
    else for (int k = start; k < end; k += lanes) found += value[k] != 0;
    return found;
"""


@wp.func_native(COUNT_NONZERO)
def count_nonzero(values: wp.array2d(dtype=wp.uint8), row: int, start: int, end: int, lanes: int) -> int:
    """How many of a row's values from `start` to `end` (not included) are not 0, in steps of `lanes`."""
    ...


# Nearly all points are looked at in vain.
NEXT_NEWS = """
    const int* flag = &wp::index(flags, e, word, 0);
    const wp::uint8* done = &wp::index(painted, row, shift);
    int found = 0, point = start;
    assert(end <= flags.shape[2] && shift + end <= painted.shape[1]);
    for (; point < end; point += lanes)
    {
        int seen = flag[point];
        for (int k = 1; k < words; ++k) seen |= wp::index(flags, e, word + k, point);
        if ((seen & mask) == 0) continue;
        ++found;
        if (done[point] == 0) break;
    }
    return wp::vec2i(point, found);
"""


@wp.func_native(NEXT_NEWS)
def next_news(
    flags: wp.array3d(dtype=wp.int32),
    e: int,
    word: int,
    words: int,
    mask: int,
    painted: wp.array2d(dtype=wp.uint8),
    row: int,
    shift: int,
    start: int,
    end: int,
    lanes: int,
) -> wp.vec2i:
    """The next point from `start` on that is known and not yet painted, and how many known ones were met up to it."""
    ...


# Nearly all points are looked at in vain, too: those who hear each other know the same of them.
NEXT_UNTOLD = f"""
    const int words = seen.shape[1], radios = hears.shape[1], points = seen.shape[2];
    const int counted = words < {TELLING_WORDS} ? words : {TELLING_WORDS};
    wp::uint32 listening[{TELLING_WORDS}], telling[{TELLING_WORDS}];  // who hears others, and who is heard by others
    for (int w = 0; w < counted; ++w) listening[w] = telling[w] = 0;
    for (int i = 0; i < radios && i < 32 * {TELLING_WORDS}; ++i)
    {{
        for (int v = 0; v < words; ++v)
        {{
            const wp::uint32 others = (wp::uint32)wp::index(hears, e, i, v) & ~(v == i / 32 ? 1u << (i % 32) : 0u);
            if (v < counted) telling[v] |= others;
            if (others != 0) listening[i / 32] |= 1u << (i % 32);
        }}
    }}
    const int* sees = &wp::index(seen, e, 0, 0);
    const int* knows = &wp::index(known, e, 0, 0);
    int point = start, single = start;
    for (; point < points; point += lanes)
    {{
        if (words == 1 && lanes == 1 && point >= single)  // without branches, many at once
        {{
            const wp::uint32 tells = telling[0], listens = listening[0];
            for (; point + {UNTOLD_BLOCK} <= points; point += {UNTOLD_BLOCK})
            {{
                wp::uint32 some = 0;
                for (int k = point; k < point + {UNTOLD_BLOCK}; ++k)
                {{
                    const wp::uint32 before = knows[k], now = before | sees[k];
                    some |= (now & ~before) | ((now & tells) != 0 ? ~now & listens : 0u);
                }}
                if (some != 0) break;
            }}
            if (point >= points) break;
            single = point + {UNTOLD_BLOCK};
        }}
        wp::uint32 any = 0, news = 0, told = 0, lacking = 0;
        for (int w = 0; w < words; ++w)
        {{
            const wp::uint32 before = knows[w * points + point], now = before | sees[w * points + point];
            any |= now;
            news |= now & ~before;
            told |= w < {TELLING_WORDS} ? now & telling[w] : now;
            lacking |= w < {TELLING_WORDS} ? ~now & listening[w] : ~now;
        }}
        if (news != 0) break;
        if (any == 0 || told == 0 || lacking == 0) continue;
        if (words > 1) break;
        bool hear = false;
        for (int i = 0; i < radios; ++i)
            hear = hear || ((lacking >> i & 1u) != 0 && (any & (wp::uint32)wp::index(hears, e, i, 0)) != 0);
        if (hear) break;
    }}
    return point;
"""


@wp.func_native(NEXT_UNTOLD)
def next_untold(
    seen: wp.array3d(dtype=wp.int32),
    known: wp.array3d(dtype=wp.int32),
    hears: wp.array3d(dtype=wp.int32),
    e: int,
    start: int,
    lanes: int,
) -> int:
    """The next point from `start` on that somebody has seen and not entered into its map, or may hear of now, in steps
    of `lanes`; the number of points or more: there is none."""
    ...
