/* Refinement of a view on the map: the loop of orthonav.core.register.refine, compiled. `_search.c` has
 * the search, `_pictures.c` and `_channels.c` what is compared, `_blocks.c`
 * blocks of a view.
 *
 * `compare` samples the map's evidence as the view's window shows it, turns its edge directions,
 * and adds up the products that a step needs, in one pass over the pixels. `refine` takes the steps.
 * `spread` adds up what the covariance is made of. `derive` makes the view's derivatives and adds up
 * their products. The Python modules do the same with NumPy; they are the oracle of this file and take
 * its place where it was not compiled.
 *
 * Only the stable ABI of Python 3.11 is used: buffers in, buffers out, no NumPy at build time. */

#include "_kernel.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LAYOUT 7        /* of all arguments and results; kernel.py has the same number */
#define FULLY_VALID 0.99f
#define OUTPUTS (22 + BLOCKS * BLOCKS)
#define PER_BLOCK (2 * 4 * 4)
#define CURVATURES (BLOCKS * BLOCKS * PER_BLOCK)
#define DERIVED (CURVATURES + 8)
#define BLOCK_SUMS 7    /* four steps' terms, both products, pixels that count */
#define SPREAD (16 + 16 + BLOCKS * BLOCKS * BLOCK_SUMS)

typedef struct {
    const float *view;      /* (H, W, 4): evidence of the view and its mask */
    const float *slopes;    /* (H, W, 8): its derivatives along x, 0, along y, 0 */
    int rows, cols;
} template_t;

typedef struct {
    lanes product, energy;
    lanes slope[2], slope_by_x[2];  /* along x and along y */
} sums_t;

INLINE float from_middle(int at, int side) { return (float)at + 0.5f - (float)side / 2.0f; }

/* Block that a row or column belongs to: the first ones are floor(side * block / BLOCKS). */
INLINE int block_of(int at, int side) { return ((at + 1) * BLOCKS - 1) / side; }

INLINE void add(sums_t *sum, const float *slopes, lanes mine, lanes other, lanes x) {
    sum->product += mine * other;
    sum->energy += other * other;
    for (int axis = 0; axis < 2; axis++) {
        const lanes step = load(slopes + LANES * axis) * other;
        sum->slope[axis] += step;
        sum->slope_by_x[axis] += x * step;
    }
}

/* A row's products of derivatives along x and y, and of these times x, as those of steps along x, y,
 * turn and log scale. */
INLINE void add_row(double *out, const sums_t *sum, float y) {
    for (int kind = 0; kind < 2; kind++, out += 4) {
        double by[4];
        for (int k = 0; k < 4; k++) {
            const lanes from = k < 2 ? sum->slope[k] : sum->slope_by_x[k - 2];
            by[k] = kind ? from[2] : (double)from[0] + from[1];
        }
        out[0] += by[0];
        out[1] += by[1];
        out[2] += by[3] - y * by[0];
        out[3] += by[2] + y * by[1];
    }
}

INLINE void add_kinds(double *out, lanes sum) {
    out[0] += (double)sum[0] + sum[1];
    out[1] += sum[2];
}

INLINE void compare_inline(const window_t *window, const template_t *view, const double *matrix,
                           float cosine, float sine, double *out) {
    const lanes straight = {cosine, cosine, 1.0f, 1.0f}, crossed = {-sine, sine, 0.0f, 0.0f};
    const float dx = (float)matrix[0], dy = (float)matrix[3];
    const float *const made = window->first;
    const Py_ssize_t stride = window->stride;
    taps_t taps;
    memset(out, 0, OUTPUTS * sizeof(double));
    for (int row = 0; row < view->rows; row++) {
        const float *values = view->view + (size_t)LANES * view->cols * row;
        const float *slopes = view->slopes + (size_t)2 * LANES * view->cols * row;
        const float down = from_middle(row, view->rows);
        lanes x = all(from_middle(0, view->cols));
        sums_t sum = {0}, left_out = {0};
        for (int first = 0; first < view->cols; first += CHUNK) {
            const int count = view->cols - first < CHUNK ? view->cols - first : CHUNK;
            const float from_x = (float)(matrix[0] * first + matrix[1] * row + matrix[2]);
            const float from_y = (float)(matrix[3] * first + matrix[4] * row + matrix[5]);
            const int is_inside = find_taps(window, from_x, from_y, dx, dy, count, &taps);
            for (int i = 0; i < count; i++, values += LANES, slopes += 2 * LANES, x += 1.0f) {
                const lanes mine = load(values);
                const lanes map =
                    is_inside ? inside(made + taps.offset[i], stride, taps.right[i], taps.below[i])
                              : sampled(window, from_x + dx * (float)i, from_y + dy * (float)i);
                if (map[3] * mine[3] > FULLY_VALID) {
                    const lanes other = {map[1], map[0], 0.0f, 0.0f};
                    add(&sum, slopes, mine, map * straight + other * crossed, x);
                } else if (mine[3] > 0.0f) {
                    add(&left_out, slopes, mine, mine, x);
                    out[22 + BLOCKS * block_of(row, view->rows) +
                        block_of(first + i, view->cols)] += 1.0;
                }
            }
        }
        add_kinds(out, sum.product);
        add_kinds(out + 2, sum.energy);
        add_kinds(out + 4, left_out.energy);
        add_row(out + 6, &sum, down);
        add_row(out + 14, &left_out, down);
    }
}

FOR_EVERY_PROCESSOR(compare,
                    (const window_t *window, const template_t *view, const double *matrix,
                     float cosine, float sine, double *out),
                    (window, view, matrix, cosine, sine, out))

/* Sobel's derivatives along x and y at one pixel, per pixel; the border is reflected. */
INLINE void sobel(const float *const rows[3], int col, int cols, lanes out[2]) {
    const int left = LANES * (col > 0 ? col - 1 : (cols > 1)), middle = LANES * col;
    const int right = LANES * (col + 1 < cols ? col + 1 : (cols > 1 ? cols - 2 : 0));
    const lanes a = load(rows[0] + left), b = load(rows[0] + middle), c = load(rows[0] + right);
    const lanes d = load(rows[1] + left), f = load(rows[1] + right);
    const lanes g = load(rows[2] + left), h = load(rows[2] + middle), i = load(rows[2] + right);
    out[0] = (c - a + 2.0f * (f - d) + i - g) * 0.125f;
    out[1] = (g - a + 2.0f * (h - b) + i - c) * 0.125f;
}

/* Derivatives of a view, and their products with each other by block and kind of evidence, then
 * those with the view itself, by kind. */
INLINE void derive_inline(const float *values, int rows, int cols, float *slopes, double *out) {
    memset(out, 0, DERIVED * sizeof(double));
    for (int row = 0; row < rows; row++) {
        const float y = from_middle(row, rows);
        const size_t width = (size_t)LANES * cols;
        const int before = row > 0 ? row - 1 : (rows > 1);
        const int after = row + 1 < rows ? row + 1 : (rows > 1 ? rows - 2 : 0);
        const float *const around[3] = {values + before * width, values + row * width,
                                        values + after * width};
        double *row_of_blocks = out + (size_t)BLOCKS * block_of(row, rows) * PER_BLOCK;
        lanes self[4] = {{0}};
        for (int block = 0; block < BLOCKS; block++) {
            const int last = cols * (block + 1) / BLOCKS;
            lanes sum[10] = {{0}};
            for (int col = cols * block / BLOCKS; col < last; col++, slopes += 2 * LANES) {
                const lanes mine = load(around[1] + LANES * col), x = all(from_middle(col, cols));
                const lanes counts = {mine[3], mine[3], mine[3], 0.0f};
                lanes slope[2];
                sobel(around, col, cols, slope);
                const lanes dx = slope[0] * counts, dy = slope[1] * counts;
                memcpy(slopes, &dx, sizeof dx);
                memcpy(slopes + LANES, &dy, sizeof dy);
                const lanes step[4] = {dx, dy, x * dy - y * dx, x * dx + y * dy};
                for (int i = 0, k = 0; i < 4; i++) {
                    self[i] += step[i] * mine;
                    for (int j = i; j < 4; j++) sum[k++] += step[i] * step[j];
                }
            }
            double *into = row_of_blocks + block * PER_BLOCK;
            for (int i = 0, k = 0; i < 4; i++)
                for (int j = i; j < 4; j++, k++) {
                    const double first = (double)sum[k][0] + sum[k][1], second = sum[k][2];
                    into[4 * i + j] += first;
                    into[16 + 4 * i + j] += second;
                    if (i == j) continue;
                    into[4 * j + i] += first;
                    into[16 + 4 * j + i] += second;
                }
        }
        for (int i = 0; i < 4; i++) {
            out[CURVATURES + i] += (double)self[i][0] + self[i][1];
            out[CURVATURES + 4 + i] += self[i][2];
        }
    }
}

FOR_EVERY_PROCESSOR(derive, (const float *values, int rows, int cols, float *slopes, double *out),
                    (values, rows, cols, slopes, out))

typedef struct {
    double x, y, turn, log_scale;   /* level-0 px, rad */
} pose_t;

/* Numbers of a template; refine.py's `template_numbers` writes them in this order. */
typedef struct {
    double pixels, energies[2], weights[2], self_slopes[2][4], hessians[2][4][4];
    double block_pixels[BLOCKS * BLOCKS], block_hessians[BLOCKS * BLOCKS][2][4][4];
} numbers_t;
#define NUMBERS ((Py_ssize_t)(sizeof(numbers_t) / sizeof(double)))

/* Where the window's first pixel lies on its level, and the limits of refine.py. */
typedef struct {
    double row, col, unit, steps, small_step_px, max_step_px, damping, min_correlation,
        whole_overlap;
} limits_t;

/* The best pose and what was seen there; the last step, scaled to its limit. */
typedef struct {
    pose_t pose;
    double score, correlations[2], weighted, overlap, converged, step[4];
} placed_t;

typedef struct {
    placed_t placed;
    double sums[OUTPUTS], gains[2], squares[2];
} seen_t;

static void matrix_of(const pose_t *pose, const template_t *view, const limits_t *limits,
                      double matrix[6]) {
    const double scale = exp(pose->log_scale);
    const double cosine = scale * cos(pose->turn), sine = scale * sin(pose->turn);
    const double x = (view->cols - 1) / 2.0, y = (view->rows - 1) / 2.0;
    matrix[0] = cosine, matrix[1] = -sine, matrix[3] = sine, matrix[4] = cosine;
    matrix[2] = pose->x / limits->unit - limits->col - 0.5 - cosine * x + sine * y;
    matrix[5] = pose->y / limits->unit - limits->row - 0.5 - sine * x - cosine * y;
}

/* As `Comparison` of refine.py. */
static void look(const window_t *window, const template_t *view, const numbers_t *numbers,
                 const limits_t *limits, const pose_t *pose, seen_t *seen) {
    double matrix[6], total = 0.0, pixels = numbers->pixels;
    const double turn = -pose->turn;
    matrix_of(pose, view, limits, matrix);
    compare(window, view, matrix, (float)cos(2 * turn), (float)sin(2 * turn), seen->sums);
    for (int block = 0; block < BLOCKS * BLOCKS; block++) pixels -= seen->sums[22 + block];
    for (int kind = 0; kind < 2; kind++) {
        const double energy = seen->sums[2 + kind];
        const double own = fmax(numbers->energies[kind] - seen->sums[4 + kind], 0.0);
        const double found =
            energy * own > 0 ? seen->sums[kind] / sqrt(energy * own) : 0.0;
        const double bounded = fmax(found, limits->min_correlation);
        seen->placed.correlations[kind] = found;
        seen->squares[kind] = bounded * bounded;
        seen->gains[kind] = energy > 0 ? sqrt(bounded * bounded * own / energy) : 0.0;
        total += numbers->weights[kind] * found;
    }
    seen->placed.pose = *pose;
    seen->placed.overlap = pixels / fmax(numbers->pixels, 1.0);
    seen->placed.weighted = total / (numbers->weights[0] + numbers->weights[1]);
    seen->placed.score = total * sqrt(fmax(pixels, 0.0)) * exp(pose->log_scale / 2);
}

/* Gauss-Newton matrix over the part of the view that lies on the map. */
static void hessian_of(const seen_t *seen, const numbers_t *numbers, const limits_t *limits,
                       double out[4][4]) {
    memset(out, 0, 16 * sizeof(double));
    const int whole = seen->placed.overlap > limits->whole_overlap;
    for (int block = 0; block < (whole ? 1 : BLOCKS * BLOCKS); block++) {
        const double pixels = numbers->block_pixels[block];
        const double share = whole ? 1.0 : (pixels - seen->sums[22 + block]) / fmax(pixels, 1.0);
        const double(*from)[4][4] = whole ? numbers->hessians : numbers->block_hessians[block];
        for (int i = 0; i < 4; i++)
            for (int j = 0; j < 4; j++)
                out[i][j] += share * (seen->squares[0] * from[0][i][j] +
                                      seen->squares[1] * from[1][i][j]);
    }
}

/* Solve for a step by elimination with pivots; the matrix and the right side are overwritten. */
static void solve(double matrix[4][4], double right[4]) {
    for (int k = 0; k < 4; k++) {
        int pivot = k;
        for (int i = k + 1; i < 4; i++)
            if (fabs(matrix[i][k]) > fabs(matrix[pivot][k])) pivot = i;
        for (int j = 0; j < 4; j++) {
            const double swapped = matrix[k][j];
            matrix[k][j] = matrix[pivot][j], matrix[pivot][j] = swapped;
        }
        const double swapped = right[k];
        right[k] = right[pivot], right[pivot] = swapped;
        for (int i = k + 1; i < 4; i++) {
            const double factor = matrix[i][k] / matrix[k][k];
            for (int j = k; j < 4; j++) matrix[i][j] -= factor * matrix[k][j];
            right[i] -= factor * right[k];
        }
    }
    for (int k = 3; k >= 0; k--) {
        for (int j = k + 1; j < 4; j++) right[k] -= matrix[k][j] * right[j];
        right[k] /= matrix[k][k];
    }
}

static void step_of(const seen_t *seen, const numbers_t *numbers, const limits_t *limits,
                    double step[4]) {
    double hessian[4][4];
    hessian_of(seen, numbers, limits, hessian);
    for (int i = 0; i < 4; i++) {
        hessian[i][i] = hessian[i][i] * (1 + limits->damping) + 1e-12;
        step[i] = 0.0;
        for (int kind = 0; kind < 2; kind++) {
            const double own = numbers->self_slopes[kind][i] - seen->sums[14 + 4 * kind + i];
            step[i] += seen->gains[kind] * seen->sums[6 + 4 * kind + i] - seen->squares[kind] * own;
        }
    }
    solve(hessian, step);
}

/* As `Refiner.place` of refine.py. */
static void refine(const window_t *window, const template_t *view, const numbers_t *numbers,
                   const limits_t *limits, placed_t *best) {
    const double reach_px = hypot(view->rows, view->cols) / 2;
    seen_t seen;
    double step[4] = {0}, converged = 0.0;
    look(window, view, numbers, limits, &best->pose, &seen);
    *best = seen.placed;
    for (int count = 0; count < (int)limits->steps && converged == 0.0; count++) {
        step_of(&seen, numbers, limits, step);
        const double moves_px = hypot(step[0], step[1]) + reach_px * hypot(step[2], step[3]);
        const double share = fmin(1.0, limits->max_step_px / fmax(moves_px, 1e-9));
        for (int i = 0; i < 4; i++) step[i] *= share;
        pose_t pose = seen.placed.pose;
        const double scale = limits->unit * exp(pose.log_scale);
        const double cosine = scale * cos(pose.turn), sine = scale * sin(pose.turn);
        pose.x -= cosine * step[0] - sine * step[1];
        pose.y -= sine * step[0] + cosine * step[1];
        pose.turn -= step[2];
        pose.log_scale -= step[3];
        look(window, view, numbers, limits, &pose, &seen);
        if (seen.placed.score > best->score) *best = seen.placed;
        converged = moves_px < limits->small_step_px;
    }
    best->converged = converged;
    memcpy(best->step, step, sizeof step);
}

/* The map (H, W, 4) as the view's window shows it, edge directions turned, zero where the view or the
 * map does not count; the last of each four is 1 where both do. */
INLINE void sample_inline(const window_t *window, const template_t *view, const double *matrix,
                          float cosine, float sine, float *into) {
    const lanes straight = {cosine, cosine, 1.0f, 0.0f}, crossed = {-sine, sine, 0.0f, 0.0f};
    const float dx = (float)matrix[0], dy = (float)matrix[3], *values = view->view;
    for (int row = 0; row < view->rows; row++) {
        const float x = (float)(matrix[1] * row + matrix[2]), y = (float)(matrix[4] * row + matrix[5]);
        for (int col = 0; col < view->cols; col++, values += LANES, into += LANES) {
            const lanes map = sampled(window, x + dx * (float)col, y + dy * (float)col);
            const float counts = map[3] * values[3] > FULLY_VALID ? 1.0f : 0.0f;
            const lanes other = {map[1], map[0], 0.0f, 0.0f}, last = {0.0f, 0.0f, 0.0f, counts};
            const lanes turned = (map * straight + other * crossed) * counts + last;
            memcpy(into, &turned, sizeof turned);
        }
    }
}

FOR_EVERY_PROCESSOR(sample,
                    (const window_t *window, const template_t *view, const double *matrix,
                     float cosine, float sine, float *into),
                    (window, view, matrix, cosine, sine, into))

/* Derivatives along x and y as those of steps along x, y, turn and log scale. */
INLINE void by_steps(lanes dx, lanes dy, lanes x, float y, lanes out[4]) {
    out[0] = dx, out[1] = dy, out[2] = x * dy - y * dx, out[3] = x * dx + y * dy;
}

/* Products of the view's derivatives and those of the map (4, 4), then by block the sums of
 * `SpreadSums.blocks` of refine.py. */
INLINE void correlate_inline(const template_t *view, const float *map, const seen_t *seen,
                             double *observed, double *out) {
    const float gain = (float)seen->gains[0], square = (float)seen->squares[0];
    const lanes gains = {gain, gain, (float)seen->gains[1], 0.0f};
    const lanes squares = {square, square, (float)seen->squares[1], 0.0f};
    const size_t width = (size_t)LANES * view->cols;
    for (int row = 0; row < view->rows; row++) {
        const int before = row > 0 ? row - 1 : (view->rows > 1);
        const int after = row + 1 < view->rows ? row + 1 : (view->rows > 1 ? view->rows - 2 : 0);
        const float *const around[3] = {map + before * width, map + row * width, map + after * width};
        const float y = from_middle(row, view->rows);
        double *into = out + (size_t)BLOCKS * BLOCK_SUMS * block_of(row, view->rows);
        lanes products[4][4] = {{{0}}};
        for (int block = 0; block < BLOCKS; block++, into += BLOCK_SUMS) {
            const int last = view->cols * (block + 1) / BLOCKS;
            lanes terms[4] = {{0}}, product = {0};
            float pixels = 0.0f;
            for (int col = view->cols * block / BLOCKS; col < last; col++) {
                const size_t at = (size_t)view->cols * row + col;
                const lanes mine = load(view->view + LANES * at), theirs = load(around[1] + LANES * col);
                const lanes x = all(from_middle(col, view->cols)), counts = all(theirs[3]);
                const float *const slopes = view->slopes + 2 * LANES * at;
                lanes slope[2], step[4], other[4];
                by_steps(load(slopes), load(slopes + LANES), x, y, step);
                sobel(around, col, view->cols, slope);
                by_steps(slope[0] * gains * counts, slope[1] * gains * counts, x, y, other);
                const lanes residual = gains * theirs - squares * mine * counts;
                for (int i = 0; i < 4; i++) {
                    terms[i] += step[i] * residual;
                    for (int j = 0; j < 4; j++) products[i][j] += step[i] * other[j];
                }
                product += mine * theirs;
                pixels += theirs[3];
            }
            for (int i = 0; i < 4; i++) into[i] += (double)terms[i][0] + terms[i][1] + terms[i][2];
            into[4] += (double)product[0] + product[1];
            into[5] += product[2];
            into[6] += pixels;
        }
        for (int i = 0; i < 4; i++)
            for (int j = 0; j < 4; j++)
                observed[4 * i + j] +=
                    (double)products[i][j][0] + products[i][j][1] + products[i][j][2];
    }
}

FOR_EVERY_PROCESSOR(correlate,
                    (const template_t *view, const float *map, const seen_t *seen, double *observed,
                     double *out),
                    (view, map, seen, observed, out))

/* What a covariance is made of; 0, or -1 without memory. */
static int spread(const window_t *window, const template_t *view, const numbers_t *numbers,
                  const limits_t *limits, const pose_t *pose, double *out) {
    const size_t pixels = (size_t)view->rows * view->cols;
    float *const map = malloc((pixels + 1) * LANES * sizeof(float));
    double matrix[6], hessian[4][4];
    seen_t seen;
    if (!map) return -1;
    memset(out, 0, SPREAD * sizeof(double));
    look(window, view, numbers, limits, pose, &seen);
    hessian_of(&seen, numbers, limits, hessian);
    memcpy(out + 16, hessian, sizeof hessian);
    matrix_of(pose, view, limits, matrix);
    sample(window, view, matrix, (float)cos(2 * pose->turn), (float)sin(-2 * pose->turn), map);
    correlate(view, map, &seen, out, out + 32);
    free(map);
    return 0;
}

int borrow(PyObject *from, Py_buffer *into, int dimensions, Py_ssize_t last, char kind, int flags) {
    if (PyObject_GetBuffer(from, into, PyBUF_STRIDES | PyBUF_FORMAT | flags) < 0) return -1;
    const Py_ssize_t size = kind == 'd' ? 8 : kind == 'f' || kind == 'i' ? 4 : 1;
    int good = into->ndim == dimensions && into->itemsize == size && into->format &&
               into->format[0] == kind && (last == ANY || into->shape[dimensions - 1] == last) &&
               into->strides[dimensions - 1] == size;
    if (good && dimensions == 3)
        good = into->strides[1] == into->shape[2] * size && into->strides[0] >= 0;
    if (good) return 0;
    PyErr_Format(PyExc_ValueError, "expected %d dimensions of '%c', the last of %zd", dimensions,
                 kind, last);
    PyBuffer_Release(into);
    return -1;
}

int is_whole(const Py_buffer *buffer) {
    Py_ssize_t size = buffer->itemsize;
    for (int at = buffer->ndim - 1; at >= 0; size *= buffer->shape[at--])
        if (buffer->strides[at] != size) return 0;
    return 1;
}

/* Whether view and slopes are contiguous and of one shape; else an error is set. */
static int are_alike(const Py_buffer *view, const Py_buffer *slopes) {
    if (is_whole(view) && is_whole(slopes) && view->shape[0] == slopes->shape[0] &&
        view->shape[1] == slopes->shape[1] && view->shape[0] <= LARGEST &&
        view->shape[1] <= LARGEST)
        return 1;
    PyErr_SetString(PyExc_ValueError, "view and slopes must be contiguous and of one shape, and no "
                                      "side longer than 32768");
    return 0;
}

/* Buffers of a window and of a template, as C sees them. */
typedef struct {
    Py_buffer made, view, slopes;
    window_t window;
    template_t template;
} images_t;

static void give_back(images_t *images) {
    PyBuffer_Release(&images->slopes);
    PyBuffer_Release(&images->view);
    PyBuffer_Release(&images->made);
}

static int borrow_images(PyObject *const from[3], images_t *images) {
    if (borrow(from[0], &images->made, 3, LANES, 'f', 0) < 0) return -1;
    if (borrow(from[1], &images->view, 3, LANES, 'f', 0) < 0) {
        PyBuffer_Release(&images->made);
        return -1;
    }
    if (borrow(from[2], &images->slopes, 3, 2 * LANES, 'f', 0) < 0) {
        PyBuffer_Release(&images->view);
        PyBuffer_Release(&images->made);
        return -1;
    }
    const Py_buffer *made = &images->made, *view = &images->view, *slopes = &images->slopes;
    if (!are_alike(view, slopes)) {
        give_back(images);
        return -1;
    }
    if (made->shape[1] <= LARGEST && made->strides[0] % 4 == 0 &&
        made->shape[0] * (made->strides[0] / 4) <= INT_MAX) {
        images->window = (window_t){made->buf, made->strides[0] / 4, (int)made->shape[0],
                                    (int)made->shape[1]};
        images->template = (template_t){view->buf, slopes->buf, (int)view->shape[0],
                                        (int)view->shape[1]};
        return 0;
    }
    PyErr_SetString(PyExc_ValueError, "window must have at most 32768 columns and 2^31 numbers");
    give_back(images);
    return -1;
}

/* A view beside the map, and a pose. */
typedef struct {
    images_t images;
    Py_buffer numbers;
    pose_t pose;
    limits_t limits;
} problem_t;

static void give_back_problem(problem_t *problem) {
    PyBuffer_Release(&problem->numbers);
    give_back(&problem->images);
}

/* 0, or -1 with an error. `out` takes the last argument; NULL where the function has none. */
static int borrow_problem(PyObject *arguments, problem_t *problem, PyObject **out) {
    PyObject *from[3], *numbers;
    pose_t *const pose = &problem->pose;
    double *const l = (double *)&problem->limits;
    if (!PyArg_ParseTuple(arguments, out ? "OOOO(dddd)(ddddddddd)O" : "OOOO(dddd)(ddddddddd)", &from[0],
                          &from[1], &from[2], &numbers, &pose->x, &pose->y, &pose->turn,
                          &pose->log_scale, &l[0], &l[1], &l[2], &l[3], &l[4], &l[5], &l[6], &l[7],
                          &l[8], out))
        return -1;
    if (borrow_images(from, &problem->images) < 0) return -1;
    if (borrow(numbers, &problem->numbers, 1, NUMBERS, 'd', 0) == 0) return 0;
    give_back(&problem->images);
    return -1;
}

static PyObject *py_refine(PyObject *self, PyObject *arguments) {
    problem_t problem;
    placed_t best;
    (void)self;
    if (borrow_problem(arguments, &problem, NULL) < 0) return NULL;
    best.pose = problem.pose;
    Py_BEGIN_ALLOW_THREADS
    refine(&problem.images.window, &problem.images.template, problem.numbers.buf, &problem.limits, &best);
    Py_END_ALLOW_THREADS
    give_back_problem(&problem);
    return Py_BuildValue("(dddd)d(dd)dddN", best.pose.x, best.pose.y, best.pose.turn,
                         best.pose.log_scale, best.score, best.correlations[0],
                         best.correlations[1], best.weighted, best.overlap, best.converged,
                         Py_BuildValue("(dddd)", best.step[0], best.step[1], best.step[2],
                                       best.step[3]));
}

static PyObject *py_derive(PyObject *self, PyObject *arguments) {
    PyObject *from, *to[2];
    Py_buffer view, slopes, out;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OOO", &from, &to[0], &to[1])) return NULL;
    if (borrow(from, &view, 3, LANES, 'f', 0) < 0) return NULL;
    if (borrow(to[0], &slopes, 3, 2 * LANES, 'f', PyBUF_WRITABLE) < 0) goto free_view;
    if (borrow(to[1], &out, 1, DERIVED, 'd', PyBUF_WRITABLE) < 0) goto free_slopes;
    if (are_alike(&view, &slopes)) {
        Py_BEGIN_ALLOW_THREADS
        derive(view.buf, (int)view.shape[0], (int)view.shape[1], slopes.buf, out.buf);
        Py_END_ALLOW_THREADS
    }
    PyBuffer_Release(&out);
free_slopes:
    PyBuffer_Release(&slopes);
free_view:
    PyBuffer_Release(&view);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

static PyObject *py_spread(PyObject *self, PyObject *arguments) {
    problem_t problem;
    Py_buffer out;
    PyObject *to;
    int failed;
    (void)self;
    if (borrow_problem(arguments, &problem, &to) < 0) return NULL;
    if (borrow(to, &out, 1, SPREAD, 'd', PyBUF_WRITABLE) == 0) {
        Py_BEGIN_ALLOW_THREADS
        failed = spread(&problem.images.window, &problem.images.template, problem.numbers.buf,
                        &problem.limits, &problem.pose, out.buf);
        Py_END_ALLOW_THREADS
        if (failed) PyErr_NoMemory();
        PyBuffer_Release(&out);
    }
    give_back_problem(&problem);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

static PyMethodDef functions[] = {
    {"refine", py_refine, METH_VARARGS,
     "refine(window, view, slopes, numbers, pose, limits): see orthonav.core.register.refine."},
    {"spread", py_spread, METH_VARARGS,
     "spread(window, view, slopes, numbers, pose, limits, out): see orthonav.core.register.refine."},
    {"derive", py_derive, METH_VARARGS,
     "derive(view, slopes, out): see orthonav.core.register.template."},
    {"channels", py_channels, METH_VARARGS,
     "channels(grey, valid, recipe, planes): see orthonav.core.register.template."},
    {"blocks", py_blocks, METH_VARARGS,
     "blocks(window, view, matrix, turn, reach, shares, correlations, pixels): see "
     "orthonav.core.register.refine."},
    {"thin", py_thin, METH_VARARGS,
     "thin(grey, factor, out): see orthonav.core.localize.view."},
    {"rectify", py_rectify, METH_VARARGS,
     "rectify(picture, nodes, grey, valid): see orthonav.core.localize.view."},
    {"bend", py_bend, METH_VARARGS,
     "bend(surfaces, blur, places, pixels, units, limits, out): see orthonav.core.localize.resection."},
    {"search", py_search, METH_VARARGS,
     "search(spectra, view, weights, poses, first, best, which, expected): see "
     "orthonav.core.register.search."},
    {"near", py_near, METH_VARARGS,
     "near(channels, view, weights, places, reach, out): see orthonav.core.register.search."},
    {"moved", py_moved, METH_VARARGS,
     "moved(window, view, weights, matrix, turn, moves, size, floor, out): see "
     "orthonav.core.register.refine."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernel", "Comparison of a view with the map.", 0, functions,
    NULL, NULL, NULL, NULL,
};

int has_avx2 = 0;

PyMODINIT_FUNC PyInit__kernel(void) {
#if defined(__x86_64__) && defined(__GNUC__)
    const char *without = getenv("ORTHONAV_NO_AVX2");
    has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
               !(without && *without);
#endif
    PyObject *made = PyModule_Create(&module);
    if (made && (PyModule_AddIntConstant(made, "LAYOUT", LAYOUT) < 0 ||
                 PyModule_AddIntConstant(made, "AVX2", has_avx2) < 0)) {
        Py_DECREF(made);
        return NULL;
    }
    return made;
}
