/* Search of a view on the map: orthonav.core.register.search and refine.sharpness, compiled.
 *
 * `search` lays a view on every place of a window under each of many poses, by Fourier transforms of
 * eight columns or rows at a time: those along a column, the product with the spectra of the map and
 * the one back stay in the processor's cache. `near` lays it on the places around each of many poses,
 * one by one. `moved` lays it on the places a little aside of one pose, by the same transforms. The
 * Python modules do the same with NumPy and OpenCV; they are the oracle of this file and take its place
 * where it was not compiled. */

#include "_kernel.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define WIDE 8          /* columns or rows that are transformed together */
#define PAIR (2 * WIDE) /* floats of their real and imaginary parts */
#define CHANNELS 3
#define MOST_FACTORS 20
#define AT_ONCE 4       /* places along a row that are compared together */

typedef float wide __attribute__((vector_size(32)));
typedef float wide_in_memory __attribute__((vector_size(32), aligned(4)));
typedef int lanes_int __attribute__((vector_size(16)));

typedef struct {
    wide re, im;
} pair_t;

typedef struct {
    wide_in_memory re, im;
} pair_in_memory_t;

#if defined(__clang__)
#define MIX(A, B, ...) __builtin_shufflevector(A, B, __VA_ARGS__)
#else
#define MIX(A, B, ...) __builtin_shuffle(A, B, (lanes_int){__VA_ARGS__})
#endif

/* Four rows of four numbers become columns. */
INLINE void transpose_four(const lanes *m, int apart, lanes *out) {
    const lanes a = MIX(m[0], m[2 * apart], 0, 4, 1, 5), b = MIX(m[0], m[2 * apart], 2, 6, 3, 7);
    const lanes c = MIX(m[apart], m[3 * apart], 0, 4, 1, 5), d = MIX(m[apart], m[3 * apart], 2, 6, 3, 7);
    out[0] = MIX(a, c, 0, 4, 1, 5), out[1] = MIX(a, c, 2, 6, 3, 7);
    out[2] = MIX(b, d, 0, 4, 1, 5), out[3] = MIX(b, d, 2, 6, 3, 7);
}

/* Eight rows of eight numbers become columns: four by four, as all processors can. */
INLINE void transpose(wide *m) {
    lanes *const halves = (lanes *)m, made[4 * 4];
    for (int block = 0; block < 4; block++)
        transpose_four(halves + 8 * (block & 1) + (block >> 1), 2, made + 4 * block);
    /* Block (0, 0), (1, 0), (0, 1), (1, 1) of the rows, each as columns. */
    for (int at = 0; at < 4; at++) {
        halves[2 * at] = made[at], halves[2 * at + 1] = made[4 + at];
        halves[8 + 2 * at] = made[8 + at], halves[8 + 2 * at + 1] = made[12 + at];
    }
}

/* ---- Fourier transform of eight sequences at once (Stockham) ---- */

typedef struct {
    int length, count, factors[MOST_FACTORS];
    float *twiddles;    /* pairs of cosine and minus sine, pass after pass */
} plan_t;

#define VECTOR lanes
#define OF_VECTOR(NAME) NAME##_lanes
#include "_transform.h"
#undef VECTOR
#undef OF_VECTOR
#if defined(__x86_64__) && defined(__GNUC__)
#define VECTOR wide
#define OF_VECTOR(NAME) NAME##_wide
#include "_transform.h"
#endif

FOR_AVX2_AND_ALL(transform, transform_wide, transform_lanes,
                 (const plan_t *plan, pair_t *data, pair_t *scratch, pair_t **ended),
                 (plan, data, scratch, ended))

/* 0; -1 where the length has other prime factors than 2, 3 and 5; -2 without memory. */
static int make_plan(int length, plan_t *plan) {
    static const int factors[] = {4, 2, 3, 5};
    int rest = length;
    size_t size = 0;
    plan->length = length, plan->count = 0, plan->twiddles = NULL;
    for (int at = 0; at < 4 && length > 0; at++)
        for (; rest % factors[at] == 0; rest /= factors[at]) plan->factors[plan->count++] = factors[at];
    if (rest != 1 || length < 1) return -1;
    for (int at = 0, done = 1; at < plan->count; done *= plan->factors[at++])
        size += (size_t)(plan->factors[at] - 1) * (length / (done * plan->factors[at]));
    float *into = plan->twiddles = malloc((2 * size + 1) * sizeof(float));
    if (!into) return -2;
    for (int at = 0, done = 1; at < plan->count; done *= plan->factors[at++])
        for (int i = 1; i < length / (done * plan->factors[at]); i++)
            for (int j = 1; j < plan->factors[at]; j++) {
                const double angle = -2 * acos(-1.0) * ((long long)j * done * i % length) / length;
                *into++ = (float)cos(angle), *into++ = (float)sin(angle);
            }
    return 0;
}

/* ---- The view as the map would show it ---- */

typedef struct {
    window_t picture;   /* evidence (H, W, 4) */
    double weights[2];  /* of the two kinds of evidence */
} view_t;

typedef struct {
    double turn, log_scale, lowest, highest;    /* the scales that are expected where it is compared */
} pose_t;

typedef struct {
    double x, y, turn, log_scale;   /* px of the level */
} place_t;

/* As `posed_half_px` of search.py, at most `LARGEST`, which fits into no window. */
static int half_of(const view_t *view, double log_scale) {
    const double half = ceil(exp(log_scale) * hypot(view->picture.rows, view->picture.cols) / 2) + 1;
    return half < LARGEST ? (int)half : LARGEST;
}

/* Planes (3, 2 half, 2 half) of a view under a pose, and the factors that give both kinds of evidence
 * the norm of their weight; as `posed_channels` of search.py. */
INLINE void pose_view_inline(const view_t *view, double turn, double log_scale, int half,
                             float *planes, float *gains) {
    const int side = 2 * half;
    const size_t area = (size_t)side * side;
    const float cosine = (float)(cos(turn) * exp(-log_scale));
    const float sine = (float)(sin(turn) * exp(-log_scale));
    const float cosine2 = (float)cos(2 * turn), sine2 = (float)sin(2 * turn);
    const float right = (float)(view->picture.cols - 1) / 2, down = (float)(view->picture.rows - 1) / 2;
    double energies[2] = {0};
    for (int row = 0; row < side; row++, planes += side) {
        const float y = (float)row + 0.5f - (float)half;
        float sums[2] = {0};
        for (int col = 0; col < side; col++) {
            const float x = (float)col + 0.5f - (float)half;
            const lanes seen = sampled(&view->picture, cosine * x + sine * y + right,
                                       cosine * y - sine * x + down);
            planes[col] = cosine2 * seen[0] - sine2 * seen[1];
            planes[area + col] = sine2 * seen[0] + cosine2 * seen[1];
            planes[2 * area + col] = seen[2];
            sums[0] += seen[0] * seen[0] + seen[1] * seen[1];
            sums[1] += seen[2] * seen[2];
        }
        energies[0] += sums[0], energies[1] += sums[1];
    }
    for (int kind = 0; kind < 2; kind++) {
        const double norm = exp(-log_scale / 2) * view->weights[kind];
        gains[kind] = energies[kind] > 0 ? (float)(norm / sqrt(energies[kind])) : 0.0f;
    }
}

FOR_EVERY_PROCESSOR(pose_view,
                    (const view_t *view, double turn, double log_scale, int half, float *planes,
                     float *gains),
                    (view, turn, log_scale, half, planes, gains))

static void *memory_for(size_t floats) {
    const size_t line = 64;
    return aligned_alloc(line, (floats * sizeof(float) + line) / line * line);
}

/* ---- Every place of a window ---- */

typedef struct {
    const pair_in_memory_t *spectra;    /* (G, 3, R): of the map, eight columns together */
    plan_t down, along;                 /* along columns of R and rows of C numbers */
    int groups, bands;                  /* G, and bands of sixteen rows that are wanted */
    int channels, wanted;               /* of the strips, and rows of the surface */
    float *planes;                      /* of the view */
    float *strips, *surface;            /* (G, channels, side, 16) and (G, wanted, 16) */
    pair_t *data, *scratch, *total;     /* of one transform, and of the sum of channels */
} search_t;

/* Best scores (B, C, 16) and the numbers of their poses; `expected` or NULL: the log scale at each
 * place. Each sixteen are eight rows of a band and the eight below. */
typedef struct {
    float *best;
    int *which;
    const float *expected;
} bests_t;

/* The middle of the view goes to the first number, what lies before it wraps to the end; all turned by
 * half a turn, for a product of spectra to be a correlation. */
INLINE int wrapped(int half, int at, int length) {
    return half - at < 0 ? half - at + length : half - at;
}

/* Into strips: spectra of two real rows each that were transformed as one complex row. Each pair of
 * rows is of `channel`, the first ones are `row`, lanes are `apart` rows from each other. */
INLINE void separate(const search_t *search, const pair_t *spectra, int side, const int channel[2],
                     const int row[2], int apart, int count) {
    const int cols = search->along.length;
    for (int group = 0; group < search->groups; group++) {
        wide parts[2][2][WIDE] = {{{{0}}}}; /* of both rows: real and imaginary ones of eight numbers */
        for (int at = 0; at < WIDE && group * WIDE + at <= cols / 2; at++) {
            const int k = group * WIDE + at;
            const pair_t here = spectra[k], there = spectra[k ? cols - k : 0];
            parts[0][0][at] = here.re + there.re, parts[0][1][at] = here.im - there.im;
            parts[1][0][at] = here.im + there.im, parts[1][1][at] = there.re - here.re;
        }
        for (int part = 0; part < 2; part++) {
            const size_t strip = (size_t)group * search->channels + channel[part];
            pair_t *into = (pair_t *)search->strips + strip * side + row[part];
            transpose(parts[part][0]);
            transpose(parts[part][1]);
            for (int lane = 0; lane < count; lane++, into += apart)
                *into = (pair_t){parts[part][0][lane], parts[part][1][lane]};
        }
    }
}

/* Eight complex rows, real parts from `re`, imaginary ones from `im`, `apart` floats between rows. */
INLINE void fill_rows(const search_t *search, const float *re, const float *im, size_t apart, int half,
                      int count, float gain) {
    const int cols = search->along.length;
    memset(search->data, 0, cols * sizeof(pair_t));
    for (int lane = 0; lane < count; lane++, re += apart, im += apart) {
        float *const into = (float *)search->data + lane;
        for (int at = 0; at < 2 * half; at++) {
            float *const place = into + (size_t)wrapped(half, at, cols) * PAIR;
            place[0] = gain * re[at], place[WIDE] = gain * im[at];
        }
    }
}

/* Transforms of the view's rows: of both gradients as one, of every two rows of grey as one. */
INLINE void transform_rows_inline(const search_t *search, int half, const float *gains) {
    const int side = 2 * half, gradients[2] = {0, 1}, grey[2] = {2, 2};
    const size_t area = (size_t)side * side;
    /* The transform back leaves the number of pixels, taking two rows apart a factor of two. */
    const float share = 0.5f / ((float)search->along.length * (float)search->down.length);
    pair_t *ended;
    for (int from = 0; from < side; from += WIDE) {
        const int count = side - from < WIDE ? side - from : WIDE, rows[2] = {from, from};
        const float *first = search->planes + (size_t)from * side;
        fill_rows(search, first, first + area, side, half, count, share * gains[0]);
        transform(&search->along, search->data, search->scratch, &ended);
        separate(search, ended, side, gradients, rows, 1, count);
    }
    for (int from = 0; from < half; from += WIDE) {
        const int count = half - from < WIDE ? half - from : WIDE, rows[2] = {2 * from, 2 * from + 1};
        const float *first = search->planes + 2 * area + (size_t)2 * from * side;
        fill_rows(search, first, first + side, 2 * side, half, count, share * gains[1]);
        transform(&search->along, search->data, search->scratch, &ended);
        separate(search, ended, side, grey, rows, 2, count);
    }
}

FOR_EVERY_PROCESSOR(transform_rows, (const search_t *search, int half, const float *gains),
                    (search, half, gains))

/* Transforms along columns, the product with the map's, summed over channels, and those back. What
 * they leave in the surface has imaginary parts first: with both parts exchanged, a transform is the
 * one back. */
INLINE void multiply_columns_inline(const search_t *search, int half) {
    const int side = 2 * half, rows = search->down.length;
    pair_t *const total = search->total, *ended;
    for (int group = 0; group < search->groups; group++) {
        for (int channel = 0; channel < CHANNELS; channel++) {
            const size_t strip = (size_t)group * CHANNELS + channel;
            const pair_t *view = (const pair_t *)search->strips + strip * side;
            const pair_in_memory_t *map = search->spectra + strip * rows;
            memset(search->data, 0, rows * sizeof(pair_t));
            for (int at = 0; at < side; at++) search->data[wrapped(half, at, rows)] = view[at];
            transform(&search->down, search->data, search->scratch, &ended);
            for (int at = 0; at < rows; at++) {
                const wide re = ended[at].re * map[at].re - ended[at].im * map[at].im;
                const wide im = ended[at].re * map[at].im + ended[at].im * map[at].re;
                total[at] = channel ? (pair_t){total[at].re + im, total[at].im + re} : (pair_t){im, re};
            }
        }
        transform(&search->down, total, search->scratch, &ended);
        memcpy(search->surface + (size_t)group * rows * PAIR, ended, rows * sizeof(pair_t));
    }
}

FOR_EVERY_PROCESSOR(multiply_columns, (const search_t *search, int half), (search, half))

/* Eight columns of a group, of the eight rows from `row` on: imaginary and real parts. */
INLINE void columns_of(const search_t *search, int group, int row, wide *im, wide *re) {
    const int rows = search->wanted;
    const pair_t *surface = (const pair_t *)search->surface + (size_t)group * rows + row;
    for (int lane = 0; lane < WIDE; lane++) {
        const pair_t found = row + lane < rows ? surface[lane] : (pair_t){{0}, {0}};
        im[lane] = found.re, re[lane] = found.im;
    }
    transpose(im);
    transpose(re);
}

/* The sixteen rows of a band, the upper eight as real rows a and the lower ones as b: the complex rows
 * a + i b, imaginary parts first. */
INLINE void join_rows(const search_t *search, int band) {
    const int cols = search->along.length, row = band * PAIR;
    wide a_re[WIDE], a_im[WIDE], b_re[WIDE], b_im[WIDE];
    for (int group = 0; group < search->groups; group++) {
        columns_of(search, group, row, a_im, a_re);
        columns_of(search, group, row + WIDE, b_im, b_re);
        for (int at = 0; at < WIDE && group * WIDE + at <= cols / 2; at++) {
            const int k = group * WIDE + at;
            search->data[k] = (pair_t){a_im[at] + b_re[at], a_re[at] - b_im[at]};
            if (k && 2 * k != cols)
                search->data[cols - k] = (pair_t){b_re[at] - a_im[at], a_re[at] + b_im[at]};
        }
    }
}

/* Take the scores (16) above the best so far, where the scale that is expected there is in reach: of
 * four at a time, which all processors compare at once. Imaginary parts are the upper rows. */
INLINE void compare_column(const float *scores, lanes_int number, float lowest, float highest,
                           float *best, int *which, const float *expected) {
    lanes_int taken[PAIR / LANES], any = {0};
    for (int part = 0; part < PAIR / LANES; part++) {
        const int at = part * LANES;
        taken[part] = load(scores + (at + WIDE) % PAIR) > load(best + at);
        if (expected) {
            const lanes scale = load(expected + at);
            taken[part] &= (scale >= lowest) & (scale <= highest);
        }
        any |= taken[part];
    }
    long long halves[2];
    memcpy(halves, &any, sizeof halves);
    if (!(halves[0] | halves[1])) return;
    for (int part = 0; part < PAIR / LANES; part++) {
        const int at = part * LANES;
        const lanes_int here = taken[part], score = (lanes_int)load(scores + (at + WIDE) % PAIR);
        lanes_int numbers, bests = (lanes_int)load(best + at);
        memcpy(&numbers, which + at, sizeof numbers);
        numbers = (here & number) | (~here & numbers), bests = (here & score) | (~here & bests);
        memcpy(which + at, &numbers, sizeof numbers);
        memcpy(best + at, &bests, sizeof bests);
    }
}

/* Transforms back along the rows, and the best score at every place. */
INLINE void compare_rows_inline(const search_t *search, int number, float lowest, float highest,
                                const bests_t *bests) {
    const int cols = search->along.length;
    const lanes_int here = (lanes_int){0} + number;
    pair_t *scores;
    for (int band = 0; band < search->bands; band++) {
        join_rows(search, band);
        transform(&search->along, search->data, search->scratch, &scores);
        for (int col = 0; col < cols; col++) {
            const size_t at = ((size_t)band * cols + col) * PAIR;
            compare_column((const float *)(scores + col), here, lowest, highest, bests->best + at,
                           bests->which + at, bests->expected ? bests->expected + at : NULL);
        }
    }
}

FOR_EVERY_PROCESSOR(compare_rows,
                    (const search_t *search, int number, float lowest, float highest,
                     const bests_t *bests),
                    (search, number, lowest, highest, bests))

/* 0, or -1 without memory. Poses under which the view does not fit into the window are left out. */
static int search_all(search_t *search, const view_t *view, const pose_t *poses, Py_ssize_t count,
                      int first, const bests_t *bests) {
    const int rows = search->down.length, cols = search->along.length;
    const int most = (rows < cols ? rows : cols) / 2, longest = rows > cols ? rows : cols;
    int largest = 0;
    for (Py_ssize_t at = 0; at < count; at++) {
        const int half = half_of(view, poses[at].log_scale);
        if (half <= most && half > largest) largest = half;
    }
    const size_t side = 2 * (size_t)largest;
    search->channels = CHANNELS, search->wanted = rows;
    search->planes = memory_for(CHANNELS * side * side);
    search->strips = memory_for(search->groups * CHANNELS * side * PAIR);
    search->surface = memory_for((size_t)search->groups * rows * PAIR);
    search->data = memory_for((size_t)longest * PAIR);
    search->scratch = memory_for((size_t)longest * PAIR);
    search->total = memory_for((size_t)rows * PAIR);
    const int has_memory = search->planes && search->strips && search->surface && search->data &&
                           search->scratch && search->total;
    for (Py_ssize_t at = 0; has_memory && at < count; at++) {
        const pose_t *pose = poses + at;
        const int half = half_of(view, pose->log_scale);
        float gains[2];
        if (half > most) continue;
        pose_view(view, pose->turn, pose->log_scale, half, search->planes, gains);
        transform_rows(search, half, gains);
        multiply_columns(search, half);
        compare_rows(search, first + (int)at, (float)pose->lowest, (float)pose->highest, bests);
    }
    free(search->planes), free(search->strips), free(search->surface);
    free(search->data), free(search->scratch), free(search->total);
    return has_memory ? 0 : -1;
}

/* ---- The places around a pose ---- */

typedef struct {
    const float *map;       /* (R, C, 3) */
    int rows, cols;
    int reach;              /* px to each side */
    float *planes, *posed;  /* of the view: (3, side, side), and interleaved, rows of `posed_floats` */
    float *around;          /* of the map, rows of `around_floats` */
    wide *sums;             /* (2 reach + 1, 2 reach + 1 rounded up) */
    int posed_floats, around_floats, across;
} near_t;

/* Floats of the posed rows that are not zero, in eights. */
INLINE void interleave(const near_t *near, int half, const float *gains, int row, int *from, int *to) {
    const int side = 2 * half;
    const size_t area = (size_t)side * side;
    const float *plane = near->planes + (size_t)row * side;
    float *into = near->posed;
    *from = side, *to = 0;
    for (int col = 0; col < side; col++) {
        const float values[] = {gains[0] * plane[col], gains[0] * plane[area + col],
                                gains[1] * plane[2 * area + col]};
        memcpy(into + CHANNELS * col, values, sizeof values);
        if (values[0] == 0.0f && values[1] == 0.0f && values[2] == 0.0f) continue;
        if (*from == side) *from = col;
        *to = col + 1;
    }
    memset(into + CHANNELS * side, 0, (near->posed_floats - CHANNELS * side) * sizeof(float));
    *from *= CHANNELS, *to *= CHANNELS;
}

/* The map around a view whose first place has its first pixel at (row, col); zero beyond the map. */
static void cut_around(const near_t *near, int row, int col, int side) {
    const int size = side + 2 * near->reach;
    const int first = col > 0 ? col : 0, last = col + size < near->cols ? col + size : near->cols;
    for (int at = 0; at < size; at++) {
        float *into = near->around + (size_t)at * near->around_floats;
        memset(into, 0, near->around_floats * sizeof(float));
        if (row + at < 0 || row + at >= near->rows || first >= last) continue;
        memcpy(into + CHANNELS * (first - col),
               near->map + CHANNELS * ((size_t)(row + at) * near->cols + first),
               (size_t)CHANNELS * (last - first) * sizeof(float));
    }
}

/* Adds a posed row times the map's, at all places, to their sums. */
INLINE void add_row_inline(const near_t *near, int row, int from, int to) {
    const int places = 2 * near->reach + 1;
    for (int down = 0; down < places; down++) {
        const float *map = near->around + (size_t)(row + down) * near->around_floats;
        wide *into = near->sums + (size_t)down * near->across;
        for (int right = 0; right < places; right += AT_ONCE, into += AT_ONCE) {
            wide sums[AT_ONCE] = {{0}};
            for (int at = from; at < to; at += WIDE) {
                const wide mine = *(const wide_in_memory *)(near->posed + at);
                for (int k = 0; k < AT_ONCE; k++)
                    sums[k] += mine * *(const wide_in_memory *)(map + at + CHANNELS * (right + k));
            }
            for (int k = 0; k < AT_ONCE; k++) into[k] += sums[k];
        }
    }
}

FOR_EVERY_PROCESSOR(add_row, (const near_t *near, int row, int from, int to), (near, row, from, to))

/* Where between three values the peak lies, from the middle one; as `_between` of search.py. */
static double peak_of(double before, double middle, double after) {
    const double bend = before - 2 * middle + after;
    return bend < 0 ? fmax(-0.5, fmin(0.5, (before - after) / (2 * bend))) : 0.0;
}

static double score_at(const near_t *near, int down, int right) {
    const wide sum = near->sums[(size_t)down * near->across + right];
    double total = 0.0;
    for (int lane = 0; lane < WIDE; lane++) total += sum[lane];
    return total;
}

/* The nearest whole number, within what fits any map. */
static int rounded(double value) { return (int)fmax(-1e6, fmin(1e6, nearbyint(value))); }

/* The best score near a place, and where: score, x and y. */
static void best_near(const near_t *near, const view_t *view, const place_t *place, double *out) {
    const int half = half_of(view, place->log_scale), places = 2 * near->reach + 1;
    const int row = rounded(place->y) - near->reach, col = rounded(place->x) - near->reach;
    int best_down = 0, best_right = 0, from, to;
    double best = -INFINITY;
    float gains[2];
    pose_view(view, place->turn, place->log_scale, half, near->planes, gains);
    cut_around(near, row - half, col - half, 2 * half);
    memset(near->sums, 0, (size_t)places * near->across * sizeof(wide));
    for (int at = 0; at < 2 * half; at++) {
        interleave(near, half, gains, at, &from, &to);
        if (from < to) add_row(near, at, from, to);
    }
    for (int down = 0; down < places; down++)
        for (int right = 0; right < places; right++) {
            const double score = score_at(near, down, right);
            if (score > best) best = score, best_down = down, best_right = right;
        }
    out[0] = best, out[1] = col + best_right, out[2] = row + best_down;
    if (best_right > 0 && best_right < places - 1)
        out[1] += peak_of(score_at(near, best_down, best_right - 1), best,
                          score_at(near, best_down, best_right + 1));
    if (best_down > 0 && best_down < places - 1)
        out[2] += peak_of(score_at(near, best_down - 1, best_right), best,
                          score_at(near, best_down + 1, best_right));
}

/* 0, or -1 without memory. A view larger than any map scores 0. */
static int search_near(near_t *near, const view_t *view, const place_t *places, Py_ssize_t count,
                       double *out) {
    int largest = 0;
    for (Py_ssize_t at = 0; at < count; at++) {
        const int half = half_of(view, places[at].log_scale);
        if (half > largest && half < LARGEST / 8) largest = half;
    }
    const size_t side = 2 * (size_t)largest, size = side + 2 * near->reach;
    near->across = (2 * near->reach + AT_ONCE) / AT_ONCE * AT_ONCE;
    near->posed_floats = (int)(CHANNELS * side + WIDE);
    near->around_floats = (int)(CHANNELS * (size + AT_ONCE) + WIDE);
    near->planes = memory_for(CHANNELS * side * side);
    near->posed = memory_for(near->posed_floats);
    near->around = memory_for(size * near->around_floats);
    near->sums = memory_for((size_t)(2 * near->reach + 1) * near->across * WIDE);
    const int has_memory = near->planes && near->posed && near->around && near->sums;
    for (Py_ssize_t at = 0; has_memory && at < count; at++, out += 3) {
        out[0] = 0.0, out[1] = places[at].x, out[2] = places[at].y;
        if (half_of(view, places[at].log_scale) <= largest) best_near(near, view, places + at, out);
    }
    free(near->planes), free(near->posed), free(near->around), free(near->sums);
    return has_memory ? 0 : -1;
}

/* ---- A view moved a little aside ---- */

typedef struct {
    search_t parts;             /* plans and memory; channels of the view, then those of the map */
    window_t view, made;        /* evidence of the view and of the map */
    const double *weights, *matrix; /* of the kinds of evidence; from the window's pixels to the map's */
    double turn, floor;         /* from map to view; power below this share of the mean counts less */
    int rows, cols, side;       /* moves to each side; rows of the window with them */
    float *map;                 /* (side, .., 4): the map as the window shows it */
    wide *products;             /* (G, 3, R, 3): real and imaginary parts, and magnitudes */
} moved_t;

/* The map as the window shows it, and the factors that give both kinds of evidence their weight. */
INLINE void sample_map_inline(const moved_t *moved, int width, float *gains) {
    const double *const matrix = moved->matrix;
    const float cosine2 = (float)cos(2 * moved->turn), sine2 = (float)sin(2 * moved->turn);
    const float dx = (float)matrix[0], dy = (float)matrix[3];
    const lanes straight = {cosine2, cosine2, 1.0f, 1.0f}, crossed = {-sine2, sine2, 0.0f, 0.0f};
    double energies[2] = {0};
    float *into = moved->map;
    for (int row = 0; row < moved->side; row++) {
        const float x = (float)(matrix[1] * row + matrix[2]), y = (float)(matrix[4] * row + matrix[5]);
        lanes sum = {0};
        for (int col = 0; col < width; col++, into += LANES) {
            const lanes seen = sampled(&moved->made, x + dx * (float)col, y + dy * (float)col);
            const lanes turned_by = seen * straight + (lanes){seen[1], seen[0], 0.0f, 0.0f} * crossed;
            memcpy(into, &turned_by, sizeof turned_by);
            sum += turned_by * turned_by;
        }
        energies[0] += sum[0] + sum[1], energies[1] += sum[2];
    }
    for (int kind = 0; kind < 2; kind++)
        gains[kind] = energies[kind] > 0 ? (float)sqrt(moved->weights[kind] / energies[kind]) : 0.0f;
}

FOR_EVERY_PROCESSOR(sample_map, (const moved_t *moved, int width, float *gains), (moved, width, gains))

/* Transforms of the rows of the view and of the map, one as real and one as imaginary parts. */
INLINE void transform_both_inline(const moved_t *moved, const float *gains) {
    const search_t *const parts = &moved->parts;
    const int width = moved->view.cols + 2 * moved->cols;
    pair_t *ended;
    for (int channel = 0; channel < CHANNELS; channel++) {
        const int channels[2] = {channel, CHANNELS + channel};
        const float gain = 0.5f * gains[channel / 2];   /* taking both apart leaves a factor of two */
        for (int from = 0; from < moved->side; from += WIDE) {
            const int count = moved->side - from < WIDE ? moved->side - from : WIDE;
            const int rows[2] = {from, from};
            memset(parts->data, 0, parts->along.length * sizeof(pair_t));
            for (int lane = 0; lane < count; lane++) {
                float *const into = (float *)parts->data + lane;
                const float *map = moved->map + (size_t)(from + lane) * width * LANES + channel;
                const float *view = moved->view.first + (from + lane) * moved->view.stride + channel;
                for (int col = 0; col < width; col++) into[col * PAIR + WIDE] = gain * map[col * LANES];
                if (from + lane >= moved->view.rows) continue;
                for (int col = 0; col < moved->view.cols; col++)
                    into[col * PAIR] = 0.5f * view[col * LANES];
            }
            transform(&parts->along, parts->data, parts->scratch, &ended);
            separate(parts, ended, moved->side, channels, rows, 1, count);
        }
    }
}

FOR_EVERY_PROCESSOR(transform_both, (const moved_t *moved, const float *gains), (moved, gains))

/* Eight columns of one channel of the strips, of which `count` rows are not zero, transformed. */
INLINE const pair_t *column_of(const moved_t *moved, int group, int channel, int count) {
    const search_t *const parts = &moved->parts;
    const size_t strip = (size_t)group * parts->channels + channel;
    pair_t *ended;
    memcpy(parts->data, (const pair_t *)parts->strips + strip * moved->side, count * sizeof(pair_t));
    memset(parts->data + count, 0, (parts->down.length - count) * sizeof(pair_t));
    transform(&parts->down, parts->data, parts->scratch, &ended);
    return ended;
}

/* Whether contiguous evidence is zero in all of a channel. */
static int is_blank(const float *evidence, size_t pixels, int channel) {
    for (size_t at = 0; at < pixels; at++)
        if (evidence[at * LANES + channel] != 0.0f) return 0;
    return 1;
}

/* Products of the spectra of view and map, and the sum of their magnitudes by channel. `shown`: 0 for
 * channels in which either is zero everywhere, else 1. There the products are zero, not what rounding
 * left when both were taken apart. */
INLINE void multiply_both_inline(const moved_t *moved, const float *shown, double *sums) {
    const search_t *const parts = &moved->parts;
    const int rows = parts->down.length;
    wide *into = moved->products;
    for (int group = 0; group < parts->groups; group++)
        for (int channel = 0; channel < CHANNELS; channel++) {
            const float counts = shown[channel];
            wide sum = {0};
            memcpy(parts->total, column_of(moved, group, channel, moved->view.rows),
                   rows * sizeof(pair_t));
            const pair_t *const view = parts->total;
            const pair_t *const map = column_of(moved, group, CHANNELS + channel, moved->side);
            for (int at = 0; at < rows; at++, into += 3) {
                const wide re = counts * (view[at].re * map[at].re + view[at].im * map[at].im);
                const wide im = counts * (view[at].re * map[at].im - view[at].im * map[at].re);
                wide size = re * re + im * im;
                for (int lane = 0; lane < WIDE; lane++) size[lane] = sqrtf(size[lane]);
                into[0] = re, into[1] = im, into[2] = size;
                sum += size;
            }
            for (int lane = 0; lane < WIDE; lane++) sums[channel] += sum[lane];
        }
}

FOR_EVERY_PROCESSOR(multiply_both, (const moved_t *moved, const float *shown, double *sums),
                    (moved, shown, sums))

/* Transforms back along columns: of gradients, of grey, and of phases alone, one above the other. As in
 * `multiply_columns`, imaginary parts first. */
INLINE void columns_back_inline(const moved_t *moved, const float *floors) {
    const search_t *const parts = &moved->parts;
    const int rows = parts->down.length, height = 2 * moved->rows + 1;
    pair_t *const total = parts->total, *ended;
    for (int group = 0; group < parts->groups; group++)
        for (int surface = 0; surface < 3; surface++) {
            const wide *const of_group = moved->products + (size_t)group * CHANNELS * rows * 3;
            const wide *const one = of_group, *const two = one + 3 * rows, *const grey = two + 3 * rows;
            for (int at = 0; at < 3 * rows; at += 3) {
                pair_t *const sum = total + at / 3;
                if (surface == 0) *sum = (pair_t){one[at + 1] + two[at + 1], one[at] + two[at]};
                else if (surface == 1) *sum = (pair_t){grey[at + 1], grey[at]};
                else {
                    const wide a = 1.0f / (one[at + 2] + floors[0]), b = 1.0f / (two[at + 2] + floors[1]);
                    const wide c = 1.0f / (grey[at + 2] + floors[2]);
                    *sum = (pair_t){a * one[at + 1] + b * two[at + 1] + c * grey[at + 1],
                                    a * one[at] + b * two[at] + c * grey[at]};
                }
            }
            transform(&parts->down, total, parts->scratch, &ended);
            memcpy((pair_t *)parts->surface + (size_t)group * parts->wanted + surface * height, ended,
                   height * sizeof(pair_t));
        }
}

FOR_EVERY_PROCESSOR(columns_back, (const moved_t *moved, const float *floors), (moved, floors))

/* Transforms back along the rows of all surfaces: (3, 2 rows + 1, 2 cols + 1). */
INLINE void rows_back_inline(const moved_t *moved, float *out) {
    const search_t *const parts = &moved->parts;
    const int width = 2 * moved->cols + 1;
    const float share = 1.0f / ((float)parts->along.length * (float)parts->down.length);
    pair_t *scores;
    for (int band = 0; band < parts->bands; band++) {
        join_rows(parts, band);
        transform(&parts->along, parts->data, parts->scratch, &scores);
        for (int at = 0; at < PAIR && band * PAIR + at < parts->wanted; at++) {
            const float *const from = (const float *)scores + (at + WIDE) % PAIR;
            float *const into = out + ((size_t)band * PAIR + at) * width;
            for (int col = 0; col < width; col++) into[col] = share * from[col * PAIR];
        }
    }
}

FOR_EVERY_PROCESSOR(rows_back, (const moved_t *moved, float *out), (moved, out))

/* 0, or -1 without memory. */
static int move_aside(moved_t *moved, float *out) {
    search_t *const parts = &moved->parts;
    const int rows = parts->down.length, cols = parts->along.length;
    const int width = moved->view.cols + 2 * moved->cols, longest = rows > cols ? rows : cols;
    const double spectrum = (double)rows * (cols / 2 + 1);
    double sums[CHANNELS] = {0};
    float gains[2], shown[CHANNELS], floors[CHANNELS];
    moved->side = moved->view.rows + 2 * moved->rows;
    parts->groups = cols / 2 / WIDE + 1, parts->channels = 2 * CHANNELS;
    parts->wanted = 3 * (2 * moved->rows + 1), parts->bands = (parts->wanted + PAIR - 1) / PAIR;
    const size_t groups = (size_t)parts->groups;
    moved->map = memory_for((size_t)moved->side * width * LANES);
    moved->products = memory_for(groups * CHANNELS * rows * 3 * WIDE);
    parts->strips = memory_for(groups * parts->channels * moved->side * PAIR);
    parts->surface = memory_for(groups * parts->wanted * PAIR);
    parts->data = memory_for((size_t)longest * PAIR);
    parts->scratch = memory_for((size_t)longest * PAIR);
    parts->total = memory_for((size_t)rows * PAIR);
    const int has_memory = moved->map && moved->products && parts->strips && parts->surface &&
                           parts->data && parts->scratch && parts->total;
    if (has_memory) {
        sample_map(moved, width, gains);
        for (int channel = 0; channel < CHANNELS; channel++)
            shown[channel] =
                gains[channel / 2] > 0 &&
                !is_blank(moved->view.first, (size_t)moved->view.rows * moved->view.cols, channel) &&
                !is_blank(moved->map, (size_t)moved->side * width, channel);
        transform_both(moved, gains);
        multiply_both(moved, shown, sums);
        for (int channel = 0; channel < CHANNELS; channel++)
            floors[channel] = (float)(moved->floor * sums[channel] / spectrum + 1e-12);
        columns_back(moved, floors);
        rows_back(moved, out);
    }
    free(moved->map), free(moved->products), free(parts->strips), free(parts->surface);
    free(parts->data), free(parts->scratch), free(parts->total);
    return has_memory ? 0 : -1;
}

/* ---- What Python calls ---- */

typedef struct {
    PyObject *from;
    int dimensions;
    Py_ssize_t last;
    char kind;
    int flags, may_be_none;
} wanted_t;

static void give_back(Py_buffer *buffers, int count) {
    while (count--)
        if (buffers[count].obj) PyBuffer_Release(buffers + count);
}

/* Borrow contiguous buffers; 0, or -1 with an error and none borrowed. */
static int borrow_all(const wanted_t *wanted, Py_buffer *buffers, int count) {
    memset(buffers, 0, count * sizeof *buffers);
    for (int at = 0; at < count; at++) {
        const wanted_t *want = wanted + at;
        if (want->from == Py_None && want->may_be_none) continue;
        if (borrow(want->from, buffers + at, want->dimensions, want->last, want->kind, want->flags) < 0) {
            buffers[at].obj = NULL;
            give_back(buffers, at);
            return -1;
        }
        int good = is_whole(buffers + at);
        for (int axis = 0; axis < want->dimensions; axis++) good &= buffers[at].shape[axis] <= INT_MAX / 64;
        if (!good) {
            PyErr_SetString(PyExc_ValueError, "arrays must be contiguous, and not too large");
            give_back(buffers, at + 1);
            return -1;
        }
    }
    return 0;
}

static view_t view_of(const Py_buffer *buffer, const double weights[2]) {
    const int rows = (int)buffer->shape[0], cols = (int)buffer->shape[1];
    return (view_t){{buffer->buf, (Py_ssize_t)LANES * cols, rows, cols}, {weights[0], weights[1]}};
}

static int is_alike(const Py_buffer *one, const Py_buffer *other) {
    return one->shape[0] == other->shape[0] && one->shape[1] == other->shape[1];
}

PyObject *py_search(PyObject *self, PyObject *arguments) {
    PyObject *from[6];
    Py_buffer got[6];
    double weights[2];
    int first, failed = 0;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OO(dd)OiOOO", &from[0], &from[1], &weights[0], &weights[1], &from[2],
                          &first, &from[3], &from[4], &from[5]))
        return NULL;
    const wanted_t wanted[6] = {{from[0], 4, PAIR, 'f', 0, 0},
                                {from[1], 3, LANES, 'f', 0, 0},
                                {from[2], 2, 4, 'd', 0, 0},
                                {from[3], 3, PAIR, 'f', PyBUF_WRITABLE, 0},
                                {from[4], 3, PAIR, 'i', PyBUF_WRITABLE, 0},
                                {from[5], 3, PAIR, 'f', 0, 1}};
    if (borrow_all(wanted, got, 6) < 0) return NULL;
    const Py_ssize_t *of_map = got[0].shape, *of_best = got[3].shape;
    search_t search = {.spectra = got[0].buf, .groups = (int)of_map[0], .bands = (int)of_best[0]};
    const bests_t bests = {got[3].buf, got[4].buf, got[5].buf};
    const view_t view = view_of(&got[1], weights);
    const int rows = (int)of_map[2], cols = (int)of_best[1];
    if (rows < 1 || cols < 1 || of_best[0] < 1 || of_map[1] != CHANNELS || of_map[0] != cols / 2 / WIDE + 1 || rows > LARGEST || cols > LARGEST ||
        (of_best[0] - 1) * PAIR >= rows || !is_alike(&got[3], &got[4]) ||
        (got[5].obj && !is_alike(&got[3], &got[5])))
        PyErr_SetString(PyExc_ValueError, "spectra, scores and numbers must be of one window");
    else if ((failed = make_plan(rows, &search.down)) || (failed = make_plan(cols, &search.along))) {
        if (failed == -2) PyErr_NoMemory();
        else PyErr_SetString(PyExc_ValueError, "sides of the window must be products of 2, 3 and 5");
    } else {
        Py_BEGIN_ALLOW_THREADS
        failed = search_all(&search, &view, got[2].buf, got[2].shape[0], first, &bests);
        Py_END_ALLOW_THREADS
        if (failed) PyErr_NoMemory();
    }
    free(search.down.twiddles), free(search.along.twiddles);
    give_back(got, 6);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

PyObject *py_near(PyObject *self, PyObject *arguments) {
    PyObject *from[4];
    Py_buffer got[4];
    double weights[2];
    int reach, failed = 0;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OO(dd)OiO", &from[0], &from[1], &weights[0], &weights[1], &from[2],
                          &reach, &from[3]))
        return NULL;
    const wanted_t wanted[4] = {{from[0], 3, CHANNELS, 'f', 0, 0},
                                {from[1], 3, LANES, 'f', 0, 0},
                                {from[2], 2, 4, 'd', 0, 0},
                                {from[3], 2, 3, 'd', PyBUF_WRITABLE, 0}};
    if (borrow_all(wanted, got, 4) < 0) return NULL;
    near_t near = {.map = got[0].buf, .rows = (int)got[0].shape[0], .cols = (int)got[0].shape[1],
                   .reach = reach};
    const view_t view = view_of(&got[1], weights);
    if (reach < 0 || reach > LARGEST || got[2].shape[0] != got[3].shape[0])
        PyErr_SetString(PyExc_ValueError, "reach must be from 0 on, and each place needs a result");
    else {
        Py_BEGIN_ALLOW_THREADS
        failed = search_near(&near, &view, got[2].buf, got[2].shape[0], got[3].buf);
        Py_END_ALLOW_THREADS
        if (failed) PyErr_NoMemory();
    }
    give_back(got, 4);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

PyObject *py_moved(PyObject *self, PyObject *arguments) {
    PyObject *from[3];
    Py_buffer got[3];
    double weights[2], matrix[6], turn, floor;
    int rows, cols, size[2], failed = 0;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OO(dd)(dddddd)d(ii)(ii)dO", &from[0], &from[1], &weights[0],
                          &weights[1], &matrix[0], &matrix[1], &matrix[2], &matrix[3], &matrix[4],
                          &matrix[5], &turn, &rows, &cols, &size[0], &size[1], &floor, &from[2]))
        return NULL;
    const wanted_t wanted[2] = {{from[1], 3, LANES, 'f', 0, 0},
                                {from[2], 3, 2 * (Py_ssize_t)cols + 1, 'f', PyBUF_WRITABLE, 0}};
    if (borrow(from[0], got, 3, LANES, 'f', 0) < 0) return NULL;
    if (borrow_all(wanted, got + 1, 2) < 0) {
        PyBuffer_Release(got);
        return NULL;
    }
    const Py_ssize_t *made = got[0].shape, *view = got[1].shape, *out = got[2].shape;
    const Py_ssize_t stride = got[0].strides[0] / 4;
    moved_t moved = {.view = {got[1].buf, LANES * view[1], (int)view[0], (int)view[1]},
                     .made = {got[0].buf, stride, (int)made[0], (int)made[1]},
                     .weights = weights, .matrix = matrix, .turn = -turn, .floor = floor,
                     .rows = rows, .cols = cols};
    search_t *const parts = &moved.parts;
    if (made[1] > LARGEST || got[0].strides[0] % 4 || made[0] * stride > INT_MAX)
        PyErr_SetString(PyExc_ValueError, "window must have at most 32768 columns and 2^31 numbers");
    else if (view[0] < 1 || view[1] < 1 || rows < 0 || cols < 0 || rows > LARGEST || cols > LARGEST ||
             out[0] != 3 || out[1] != 2 * rows + 1 || size[0] > LARGEST || size[1] > LARGEST ||
             view[0] + 2 * rows > size[0] || view[1] + 2 * cols > size[1])
        PyErr_SetString(PyExc_ValueError, "view, moves, sides of the transform and scores do not match");
    else if ((failed = make_plan(size[0], &parts->down)) || (failed = make_plan(size[1], &parts->along))) {
        if (failed == -2) PyErr_NoMemory();
        else PyErr_SetString(PyExc_ValueError, "sides of the transform must be products of 2, 3 and 5");
    } else {
        Py_BEGIN_ALLOW_THREADS
        failed = move_aside(&moved, got[2].buf);
        Py_END_ALLOW_THREADS
        if (failed) PyErr_NoMemory();
    }
    free(parts->down.twiddles), free(parts->along.twiddles);
    give_back(got, 3);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}
