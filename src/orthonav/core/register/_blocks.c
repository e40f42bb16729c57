/* Blocks of a view beside the map, moved a little aside: orthonav.core.register.refine, compiled.
 *
 * The map is sampled once, in planes, with a margin; then each block is multiplied with it under all
 * moves, eight pixels at a time. Rows of a block are filled up to whole vectors with zeros. `bend` is
 * `_pulls` of orthonav.core.localize.resection, by quadratics through these correlations. */

#include "_kernel.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define FULLY_VALID 0.99f
#define CHANNELS 3      /* that are compared; validity is the fourth plane */
#define ASIDE 9         /* moves along a row that are added up together, at most: registers hold no more */

typedef float wide __attribute__((vector_size(32)));
typedef float wide_in_memory __attribute__((vector_size(32), aligned(4)));
#define WIDE 8

INLINE wide load_wide(const float *from) { return *(const wide_in_memory *)from; }

INLINE float sum_of(wide v) {
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

/* A view (4, rows, cols), and the map around it (4, rows + 2 reach, stride). `block`: room for one
 * block of the view (4, ..), `energies` (2 B^2, 3) of each block, of the view, then of the map. */
typedef struct {
    const float *view;
    int rows, cols, reach;
    size_t stride, plane;
    float *map, *block;
    double (*energies)[CHANNELS];
} aside_t;

/* The map as the view's window shows it, `reach` pixels around too, edge directions turned; zero where
 * it is not valid. */
INLINE void sample_map_inline(const window_t *window, const aside_t *with, const double *matrix,
                          float cosine, float sine) {
    const int width = with->cols + 2 * with->reach, height = with->rows + 2 * with->reach;
    const float dx = (float)matrix[0], dy = (float)matrix[3];
    taps_t taps;
    for (int row = 0; row < height; row++) {
        float *const into = with->map + with->stride * row;
        for (int first = 0; first < width; first += CHUNK) {
            const int count = width - first < CHUNK ? width - first : CHUNK;
            const float x = (float)(matrix[0] * first + matrix[1] * row + matrix[2]);
            const float y = (float)(matrix[3] * first + matrix[4] * row + matrix[5]);
            const int is_inside = find_taps(window, x, y, dx, dy, count, &taps);
            for (int i = 0; i < count; i++) {
                const lanes seen =
                    is_inside ? inside(window->first + taps.offset[i], window->stride,
                                       taps.right[i], taps.below[i])
                              : sampled(window, x + dx * (float)i, y + dy * (float)i);
                const float counts = seen[3] < FULLY_VALID ? 0.0f : 1.0f;
                float *const at = into + first + i;
                at[0] = counts * (cosine * seen[0] + sine * seen[1]);
                at[with->plane] = counts * (cosine * seen[1] - sine * seen[0]);
                at[2 * with->plane] = counts * seen[2];
                at[3 * with->plane] = counts * seen[3];
            }
        }
        for (int channel = 0; channel <= CHANNELS; channel++)
            memset(into + with->plane * channel + width, 0,
                   sizeof(float) * (with->stride - (size_t)width));
    }
}

FOR_EVERY_PROCESSOR(sample_map,
                    (const window_t *window, const aside_t *with, const double *matrix, float cosine,
                     float sine),
                    (window, with, matrix, cosine, sine))

typedef struct {
    int top, bottom, left, right;
    size_t wide;    /* vectors of a row */
} block_t;

static block_t block_at(const aside_t *with, int number) {
    const int i = number / BLOCKS, j = number % BLOCKS;
    block_t made = {i * with->rows / BLOCKS, (i + 1) * with->rows / BLOCKS,
                    j * with->cols / BLOCKS, (j + 1) * with->cols / BLOCKS, 0};
    made.wide = ((size_t)(made.right - made.left) + WIDE - 1) / WIDE;
    return made;
}

/* Rows of one plane of a view's block, filled up with zeros. */
static void take_block(const aside_t *with, const block_t *at, int channel) {
    const size_t pixels = (size_t)(at->right - at->left), padded = at->wide * WIDE;
    const float *from = with->view + (size_t)with->cols * ((size_t)with->rows * channel + at->top);
    float *into = with->block;
    for (int row = at->top; row < at->bottom; row++, from += with->cols, into += padded) {
        memcpy(into, from + at->left, sizeof(float) * pixels);
        memset(into + pixels, 0, sizeof(float) * (padded - pixels));
    }
}

/* Energies of each block, and the pixels (B^2,) that count in both. */
INLINE void weigh_inline(const aside_t *with, double *pixels) {
    for (int number = 0; number < BLOCKS * BLOCKS; number++) {
        const block_t at = block_at(with, number);
        const int rest = at.right - at.left - ((int)at.wide - 1) * WIDE;
        wide last;
        for (int i = 0; i < WIDE; i++) last[i] = i < rest ? 1.0f : 0.0f;
        for (int channel = 0; channel <= CHANNELS; channel++) {
            wide own = {0}, seen = {0}, both = {0};
            const float *mine = with->block;
            take_block(with, &at, channel);
            for (int row = at.top; row < at.bottom; row++) {
                const float *other = with->map + with->plane * channel + with->reach + at.left +
                                     with->stride * (row + with->reach);
                for (size_t i = 0; i < at.wide; i++, mine += WIDE, other += WIDE) {
                    const wide view = load_wide(mine), map = load_wide(other);
                    const wide counted = i + 1 < at.wide ? map : map * last;
                    own += view * view, seen += map * counted, both += view * map;
                }
            }
            if (channel < CHANNELS) {
                with->energies[number][channel] = sum_of(own);
                with->energies[BLOCKS * BLOCKS + number][channel] = sum_of(seen);
            } else pixels[number] = sum_of(both);
        }
    }
}

FOR_EVERY_PROCESSOR(weigh, (const aside_t *with, double *pixels), (with, pixels))

/* A block of one plane times the map at `other`, under `count` moves along the row; all from `first`
 * on are added to `out`. */
INLINE void add_moves(const aside_t *with, const block_t *at, const float *other, int first, int count,
                      float weight, float *out) {
    wide sums[ASIDE] = {{0}};
    const float *mine = with->block;
    for (int row = at->top; row < at->bottom; row++, other += with->stride)
        for (size_t i = 0; i < at->wide; i++, mine += WIDE) {
            const wide view = load_wide(mine);
            for (int move = 0; move < count; move++)
                sums[move] += view * load_wide(other + WIDE * i + move);
        }
    for (int move = 0; move < count; move++)
        if (move >= first) out[move] += weight * sum_of(sums[move]);
}

/* Products (B^2, 2 R + 1, 2 R + 1) of each block with the map under all moves. */
INLINE void multiply_inline(const aside_t *with, const float *weights, float *out) {
    const int moves = 2 * with->reach + 1;
    const int together = moves % 9 == 0 ? 9 : moves >= 8 ? 8 : 1;
    memset(out, 0, sizeof(float) * BLOCKS * BLOCKS * moves * moves);
    for (int number = 0; number < BLOCKS * BLOCKS; number++) {
        const block_t at = block_at(with, number);
        for (int channel = 0; channel < CHANNELS; channel++) {
            const float weight = weights[channel];
            take_block(with, &at, channel);
            for (int down = 0; down < moves; down++) {
                const float *other =
                    with->map + with->plane * channel + with->stride * (at.top + down) + at.left;
                float *into = out + ((size_t)number * moves + down) * moves;
                for (int done = 0, next; done < moves; done = next + together) {
                    next = done < moves - together ? done : moves - together;
                    if (together == 9)
                        add_moves(with, &at, other + next, done - next, 9, weight, into + next);
                    else if (together == 8)
                        add_moves(with, &at, other + next, done - next, 8, weight, into + next);
                    else add_moves(with, &at, other + next, done - next, 1, weight, into + next);
                }
            }
        }
    }
}

FOR_EVERY_PROCESSOR(multiply, (const aside_t *with, const float *weights, float *out),
                    (with, weights, out))

/* What orthonav.core.register.refine says of them: grey's energy over that of gradients, and of a block
 * that counts the least share of pixels, and of energy over the median. */
typedef struct {
    double grey, seen, energy;
} shares_t;

static int ascending(const void *one, const void *other) {
    const double a = *(const double *)one, b = *(const double *)other;
    return (a > b) - (a < b);
}

static double median_of(const double *values) {
    double sorted[BLOCKS * BLOCKS];
    memcpy(sorted, values, sizeof sorted);
    qsort(sorted, BLOCKS * BLOCKS, sizeof *sorted, ascending);
    return (sorted[BLOCKS * BLOCKS / 2 - 1] + sorted[BLOCKS * BLOCKS / 2]) / 2;
}

/* Correlations of blocks under all moves by their `products`, and the pixels that count; both 0 where
 * too few do. */
static void normalize(const aside_t *with, const shares_t *shares, const float *products,
                      const double sums[2][BLOCKS * BLOCKS], double *out, double *pixels) {
    const size_t moves = 2 * (size_t)with->reach + 1, each = moves * moves;
    const double least[2] = {shares->energy * median_of(sums[0]), shares->energy * median_of(sums[1])};
    const double seen = shares->seen * with->rows * with->cols / (BLOCKS * BLOCKS);
    for (int block = 0; block < BLOCKS * BLOCKS; block++, products += each, out += each) {
        const int used =
            pixels[block] >= seen && sums[0][block] > least[0] && sums[1][block] > least[1];
        const double scale = used ? 1 / sqrt(sums[0][block] * sums[1][block]) : 0.0;
        if (!used) pixels[block] = 0.0;
        for (size_t i = 0; i < each; i++) {
            const double found = scale * products[i], high = found > 1.0 ? 1.0 : found;
            out[i] = high < -1.0 ? -1.0 : high;
        }
    }
}

/* Correlations and pixels of all blocks; 0, or -1 without memory. */
static int compare_aside(const window_t *window, aside_t *with, const double *matrix, double turn,
                         const shares_t *shares, double *out, double *pixels) {
    const int count = BLOCKS * BLOCKS;
    const size_t height = (size_t)with->rows + 2 * (size_t)with->reach;
    const size_t tall = (size_t)with->rows / BLOCKS + 1, broad = (size_t)with->cols / BLOCKS + 1;
    const size_t moves = 2 * (size_t)with->reach + 1;
    double energies[2 * BLOCKS * BLOCKS][CHANNELS], sums[2][BLOCKS * BLOCKS];
    float weights[CHANNELS] = {1.0f, 1.0f, 1.0f};
    with->stride = (size_t)with->cols + 2 * (size_t)with->reach + WIDE;
    with->plane = with->stride * height;
    with->energies = energies;
    with->map = malloc(sizeof(float) * (CHANNELS + 1) * with->plane);
    with->block = malloc(sizeof(float) * tall * (broad + WIDE));
    float *const products = malloc(sizeof(float) * BLOCKS * BLOCKS * moves * moves);
    const int failed = !with->map || !with->block || !products;
    if (!failed) {
        sample_map(window, with, matrix, (float)cos(2 * turn), (float)sin(2 * turn));
        weigh(with, pixels);
        for (int each = 0; each < 2; each++) {
            double gradients = 0.0, grey = 0.0;
            const double(*const from)[CHANNELS] = energies + each * count;
            for (int i = 0; i < count; i++) gradients += from[i][0] + from[i][1], grey += from[i][2];
            const double weight = grey > 0 ? shares->grey * gradients / grey : 0.0;
            for (int i = 0; i < count; i++)
                sums[each][i] = from[i][0] + from[i][1] + weight * from[i][2];
            weights[2] *= (float)sqrt(weight);
        }
        multiply(with, weights, products);
        normalize(with, shares, products, sums, out, pixels);
    }
    free(with->map), free(with->block), free(products);
    return failed ? -1 : 0;
}

PyObject *py_blocks(PyObject *self, PyObject *arguments) {
    PyObject *from[4];
    Py_buffer made, view, out, pixels;
    double matrix[6], turn;
    shares_t shares;
    int reach;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OO(dddddd)di(ddd)OO", &from[0], &from[1], &matrix[0], &matrix[1],
                          &matrix[2], &matrix[3], &matrix[4], &matrix[5], &turn, &reach, &shares.grey,
                          &shares.seen, &shares.energy, &from[2], &from[3]))
        return NULL;
    if (reach < 0 || reach > LARGEST) {
        PyErr_SetString(PyExc_ValueError, "reach must match the correlations");
        return NULL;
    }
    if (borrow(from[0], &made, 3, LANES, 'f', 0) < 0) return NULL;
    if (borrow(from[1], &view, 3, ANY, 'f', 0) < 0) goto free_made;
    if (borrow(from[2], &out, 3, 2 * (Py_ssize_t)reach + 1, 'd', PyBUF_WRITABLE) < 0) goto free_view;
    if (borrow(from[3], &pixels, 1, BLOCKS * BLOCKS, 'd', PyBUF_WRITABLE) < 0) goto free_out;
    const Py_ssize_t rows = view.shape[1], cols = view.shape[2], stride = made.strides[0] / 4;
    if (made.shape[1] > LARGEST || made.strides[0] % 4 || made.shape[0] * stride > INT_MAX)
        PyErr_SetString(PyExc_ValueError, "window must have at most 32768 columns and 2^31 numbers");
    else if (!is_whole(&view) || !is_whole(&out) || !is_whole(&pixels) || view.shape[0] != LANES ||
             rows < BLOCKS || cols < BLOCKS || rows > LARGEST || cols > LARGEST ||
             out.shape[0] != BLOCKS * BLOCKS || out.shape[1] != out.shape[2])
        PyErr_SetString(PyExc_ValueError, "view, reach and correlations do not match");
    else {
        const window_t window = {made.buf, stride, (int)made.shape[0], (int)made.shape[1]};
        aside_t with = {.view = view.buf, .rows = (int)rows, .cols = (int)cols, .reach = reach};
        int failed;
        Py_BEGIN_ALLOW_THREADS
        failed = compare_aside(&window, &with, matrix, turn, &shares, out.buf, pixels.buf);
        Py_END_ALLOW_THREADS
        if (failed) PyErr_NoMemory();
    }
    PyBuffer_Release(&pixels);
free_out:
    PyBuffer_Release(&out);
free_view:
    PyBuffer_Release(&view);
free_made:
    PyBuffer_Release(&made);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

#define BENT 7          /* value, slopes by x and y, curvatures (2, 2) */
#define PULLS 6         /* slopes and curvatures */
#define WIDEST 64       /* surface that is blurred */
#define MOST_ODDS 30.0

/* As `_positive` of orthonav.core.localize.resection. */
static void make_positive(double along, double across, double down, double out[4]) {
    const double half = (along + down) / 2, apart = hypot((along - down) / 2, across);
    const double scale = half >= apart ? 1.0 : half <= -apart ? 0.0 : (half + apart) / (2 * apart);
    const double shift = half >= apart || half <= -apart ? 0.0 : apart - half;
    out[0] = scale * (along + shift), out[3] = scale * (down + shift);
    out[1] = out[2] = scale * across;
}

/* The nine numbers around (row, col) of a surface, blurred along both axes. */
INLINE void blur_around_inline(const double *surface, const double *blur, int side, int row, int col,
                               double *out) {
    double line[WIDEST];
    for (int i = -1; i <= 1; i++, out += 3) {
        const double *const down = blur + side * (row + i);
        for (int x = 0; x < side; x++) line[x] = 0.0;
        for (int y = 0; y < side; y++)
            for (int x = 0; x < side; x++) line[x] += down[y] * surface[side * y + x];
        for (int j = -1; j <= 1; j++) {
            const double *const across = blur + side * (col + j);
            double total = 0.0;
            for (int x = 0; x < side; x++) total += across[x] * line[x];
            out[j + 1] = total;
        }
    }
}

FOR_EVERY_PROCESSOR(blur_around,
                    (const double *surface, const double *blur, int side, int row, int col, double *out),
                    (surface, blur, side, row, col, out))

/* As `_quadratic` of orthonav.core.localize.resection, of one surface, blurred unless `blur` is NULL. */
static void bend(const double *surface, const double *blur, int side, double x, double y,
                 double out[BENT]) {
    const int reach = side / 2;
    double around[9];
    memset(out, 0, sizeof(double) * BENT);
    if (!(fabs(x) <= reach && fabs(y) <= reach)) return;
    const double right = rint(fmin(fmax(x, 1 - reach), reach - 1));
    const double below = rint(fmin(fmax(y, 1 - reach), reach - 1));
    const int row = (int)below + reach, col = (int)right + reach, step = blur ? 3 : side;
    if (blur) blur_around(surface, blur, side, row, col, around);
    const double *const at = blur ? around + 4 : surface + side * row + col;
    const double by_x = (at[1] - at[-1]) / 2, by_y = (at[step] - at[-step]) / 2;
    const double along = 2 * at[0] - at[1] - at[-1], down = 2 * at[0] - at[step] - at[-step];
    const double across = (at[1 - step] + at[step - 1] - at[step + 1] - at[-step - 1]) / 4;
    const double off_x = x - right, off_y = y - below; /* at most 1 */
    const double bent_x = along * off_x + across * off_y, bent_y = across * off_x + down * off_y;
    out[0] = at[0] + (by_x - bent_x / 2) * off_x + (by_y - bent_y / 2) * off_y;
    out[1] = by_x - bent_x, out[2] = by_y - bent_y;
    make_positive(along, across, down, out + 3);
}

/* Limits of the mean correlation of a right block, and pixels per independent number. */
typedef struct {
    double least, most, numbers;
} odds_t;

/* Add to `out` (count, PULLS) what `_pulls` of orthonav.core.localize.resection says of one level, by
 * its blocks' quadratics (count, BENT). */
static void add_level(const double *bent, const double *pixels, const double *units, Py_ssize_t count,
                      const odds_t *limits, double *out) {
    double weighted = 0.0, counted = 0.0;
    for (Py_ssize_t i = 0; i < count; i++)
        weighted += bent[BENT * i] * pixels[i], counted += pixels[i];
    const double usual = fmin(fmax(weighted / fmax(counted, 1.0), limits->least), limits->most);
    const double share = usual / (1 - usual * usual) / limits->numbers;
    for (Py_ssize_t i = 0; i < count; i++, bent += BENT, out += PULLS) {
        const double odds = share * pixels[i] * (bent[0] - usual / 2);
        const double held = fmin(fmax(odds, -MOST_ODDS), MOST_ODDS);
        const double weight = share * pixels[i] / (1 + exp(-held)) / units[i];
        for (int j = 0; j < 2; j++) out[j] += weight * bent[1 + j];
        for (int j = 2; j < PULLS; j++) out[j] += weight / units[i] * bent[1 + j];
    }
}

PyObject *py_bend(PyObject *self, PyObject *arguments) {
    PyObject *from[6];
    Py_buffer surfaces, blur, moved, pixels, units, out;
    odds_t limits;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OOOOO(ddd)O", &from[0], &from[1], &from[2], &from[3], &from[4],
                          &limits.least, &limits.most, &limits.numbers, &from[5]))
        return NULL;
    if (borrow(from[0], &surfaces, 3, ANY, 'd', 0) < 0) return NULL;
    const Py_ssize_t count = surfaces.shape[0], side = surfaces.shape[1];
    const int is_blurred = from[1] != Py_None;
    if (is_blurred && borrow(from[1], &blur, 2, side, 'd', 0) < 0) goto free_surfaces;
    if (borrow(from[2], &moved, 2, 2, 'd', 0) < 0) goto free_blur;
    if (borrow(from[3], &pixels, 1, count, 'd', 0) < 0) goto free_moved;
    if (borrow(from[4], &units, 1, count, 'd', 0) < 0) goto free_pixels;
    if (borrow(from[5], &out, 2, PULLS, 'd', PyBUF_WRITABLE) < 0) goto free_units;
    const Py_ssize_t blocks = out.shape[0];
    if (!is_whole(&surfaces) || !is_whole(&moved) || !is_whole(&out) || side != surfaces.shape[2] ||
        side < 3 || side > WIDEST || side % 2 == 0 || moved.shape[0] != count ||
        (is_blurred && (!is_whole(&blur) || blur.shape[0] != side)) || blocks < 1 || count % blocks)
        PyErr_SetString(PyExc_ValueError, "surfaces, places and results do not match");
    else {
        double *const bent = malloc(sizeof(double) * BENT * (size_t)blocks);
        if (bent) memset(out.buf, 0, sizeof(double) * PULLS * (size_t)blocks);
        else PyErr_NoMemory();
        for (Py_ssize_t first = 0; bent && first < count; first += blocks) {
            for (Py_ssize_t i = 0; i < blocks; i++) {
                const double *const at = (const double *)moved.buf + 2 * (first + i);
                bend((const double *)surfaces.buf + side * side * (first + i),
                     is_blurred ? blur.buf : NULL, (int)side, at[0], at[1], bent + BENT * i);
            }
            add_level(bent, (const double *)pixels.buf + first, (const double *)units.buf + first,
                      blocks, &limits, out.buf);
        }
        free(bent);
    }
    PyBuffer_Release(&out);
free_units:
    PyBuffer_Release(&units);
free_pixels:
    PyBuffer_Release(&pixels);
free_moved:
    PyBuffer_Release(&moved);
free_blur:
    if (is_blurred) PyBuffer_Release(&blur);
free_surfaces:
    PyBuffer_Release(&surfaces);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}
