/* Channels of a picture: orthonav.core.register.template, compiled.
 *
 * Loops are such that compilers make vectors of them. At borders pictures are reflected without their
 * first pixel, as OpenCV does. */

#include "_kernel.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define GRADIENT_FLOOR 0.5f
#define DEVIATION_FLOOR 2.0f
#define CLIP 3.0f
#define LEAST_COUNT 1e-3f
#define MOST_TAPS 33    /* of a Gaussian */
#define PLANES 6        /* of memory for one picture, */
#define LINES 3         /* and lines */

/* Widths of windows, pixels: of gradients' surroundings, and of mean and deviation of grey. */
typedef struct {
    double sigma;
    int contrast, mean, deviation;
} recipe_t;

/* A picture (rows, cols): grey levels, and which are valid; NULL: all. `memory`: for planes, the
 * last of them `along`; `lines`: for rows with `margin` on both sides. */
typedef struct {
    const unsigned char *grey, *valid;
    int rows, cols, margin;
    float *memory, *along, *lines;
} picture_t;

INLINE int reflected(int at, int size) {
    if (size == 1) return 0;
    while (at < 0 || at >= size) at = at < 0 ? -at : 2 * size - 2 - at;
    return at;
}

/* Fill what lies up to `reach` beside a line of `cols` numbers. */
INLINE void reflect(float *line, int cols, int reach) {
    for (int i = 1; i <= reach; i++) {
        line[-i] = line[reflected(-i, cols)];
        line[cols + i - 1] = line[reflected(cols + i - 1, cols)];
    }
}

/* Sums over `side` numbers of a padded line from each of the first `cols` on, of sums over powers of
 * two: running sums would depend on each other. `other`: as much room. */
INLINE void add_along(float *line, float *other, int cols, int side, float *restrict to) {
    int last = cols + side - 1, from = 0;
    for (int wide = 1; wide <= side; wide *= 2) {
        if (side & wide) {
            const float *const here = line + from;
            if (from)
                for (int col = 0; col < cols; col++) to[col] += here[col];
            else
                memcpy(to, here, sizeof(float) * (size_t)cols);
            from += wide;
        }
        last -= wide;
        const float *const restrict one = line, *const restrict two = line + wide;
        float *const restrict into = other;
        for (int col = 0; col < last; col++) into[col] = one[col] + two[col];
        other = line, line = into;
    }
}

/* Mean (rows, cols) over a square around each number; `side` is odd. */
INLINE void box(const picture_t *with, const float *from, int side, float *restrict to) {
    const int rows = with->rows, cols = with->cols, least = rows < cols ? rows : cols;
    const int reach = (side < 2 * least - 1 ? side : 2 * least - 1) / 2;
    const float count = (float)((2 * reach + 1) * (2 * reach + 1)); /* so that uniform ones are exact */
    const size_t apart = (size_t)cols + 2 * (size_t)with->margin;
    float *const line = with->lines + with->margin, *restrict total = line + 2 * apart;
    float *const restrict along = with->along;
    for (int row = 0; row < rows; row++) {
        memcpy(line, from + (size_t)cols * row, sizeof(float) * (size_t)cols);
        reflect(line, cols, reach);
        add_along(line - reach, line + apart - reach, cols, 2 * reach + 1, along + (size_t)cols * row);
    }
    memset(total, 0, sizeof(float) * (size_t)cols);
    for (int row = -reach; row <= reach; row++) {
        const float *const next = along + (size_t)cols * reflected(row, rows);
        for (int col = 0; col < cols; col++) total[col] += next[col];
    }
    for (int row = 0; row < rows; row++) {
        float *const restrict into = to + (size_t)cols * row;
        const float *const next = along + (size_t)cols * reflected(row + reach + 1, rows);
        const float *const gone = along + (size_t)cols * reflected(row - reach, rows);
        for (int col = 0; col < cols; col++) {
            into[col] = total[col] / count;
            total[col] += next[col] - gone[col];
        }
    }
}

/* As `_LocalMean`; `counts` has room for a plane, and `share` the valid pixels, NULL: all. */
INLINE void local_mean(const picture_t *with, const float *from, const float *share, int side,
                       float *restrict counts, float *restrict to) {
    const size_t pixels = (size_t)with->rows * with->cols;
    box(with, from, side, to);
    if (!share) return;
    box(with, share, side, counts);
    for (size_t i = 0; i < pixels; i++) to[i] /= counts[i] > LEAST_COUNT ? counts[i] : LEAST_COUNT;
}

/* 1 where all pixels within `reach` are valid, beyond the border too. */
INLINE void eroded(const picture_t *with, int reach, float *restrict to) {
    const int rows = with->rows, cols = with->cols;
    for (int row = 0; row < rows; row++)
        for (int col = 0; col < cols; col++) to[(size_t)cols * row + col] = 1.0f;
    for (int row = 0; row < rows; row++)
        for (int col = 0; col < cols; col++) {
            if (with->valid[(size_t)cols * row + col]) continue;
            const int left = col > reach ? col - reach : 0;
            const int right = col + reach < cols ? col + reach : cols - 1;
            /* Of pixels beside each other the first clears the whole square, each next one a column. */
            const int from = col > 0 && !with->valid[(size_t)cols * row + col - 1] ? right : left;
            for (int y = row > reach ? row - reach : 0; y <= row + reach && y < rows; y++)
                for (int x = from; x <= right; x++) to[(size_t)cols * y + x] = 0.0f;
        }
}

/* Gaussian blur as OpenCV's of a picture of floats. */
INLINE void blurred(const picture_t *with, const float *from, double sigma, float *restrict scratch,
                    float *restrict to) {
    const int rows = with->rows, cols = with->cols, reach = ((int)rint(8 * sigma + 1) | 1) / 2;
    float taps[MOST_TAPS], *restrict line = with->lines + with->margin;
    double total = 0.0;
    for (int i = -reach; i <= reach; i++) total += exp(-i * i / (2 * sigma * sigma));
    for (int i = 0; i <= reach; i++) taps[i] = (float)(exp(-i * i / (2 * sigma * sigma)) / total);
    for (int row = 0; row < rows; row++) {
        float *restrict into = scratch + (size_t)cols * row;
        memcpy(line, from + (size_t)cols * row, sizeof(float) * (size_t)cols);
        reflect(line, cols, reach);
        for (int col = 0; col < cols; col++) into[col] = taps[0] * line[col];
        for (int i = 1; i <= reach; i++)
            for (int col = 0; col < cols; col++) into[col] += taps[i] * (line[col - i] + line[col + i]);
    }
    for (int row = 0; row < rows; row++) {
        float *restrict into = to + (size_t)cols * row;
        const float *const here = scratch + (size_t)cols * row;
        for (int col = 0; col < cols; col++) into[col] = taps[0] * here[col];
        for (int i = 1; i <= reach; i++) {
            const float *const above = scratch + (size_t)cols * reflected(row - i, rows);
            const float *const under = scratch + (size_t)cols * reflected(row + i, rows);
            for (int col = 0; col < cols; col++) into[col] += taps[i] * (above[col] + under[col]);
        }
    }
}

/* Scharr's derivatives of a picture, squared as a complex number, and their magnitude. */
INLINE void differentiated(const picture_t *with, const float *from, const float *counts,
                           float *restrict real, float *restrict imaginary, float *restrict magnitude) {
    const int rows = with->rows, cols = with->cols;
    const size_t apart = (size_t)cols + 2 * (size_t)with->margin;
    float *restrict mean = with->lines + with->margin, *restrict step = mean + apart;
    for (int row = 0; row < rows; row++) {
        const float *const above = from + (size_t)cols * reflected(row - 1, rows);
        const float *const under = from + (size_t)cols * reflected(row + 1, rows);
        const float *const here = from + (size_t)cols * row;
        const size_t at = (size_t)cols * row;
        for (int col = 0; col < cols; col++) {
            mean[col] = 3.0f * (above[col] + under[col]) + 10.0f * here[col];
            step[col] = under[col] - above[col];
        }
        reflect(mean, cols, 1);
        reflect(step, cols, 1);
        for (int col = 0; col < cols; col++) {
            const float east = (mean[col + 1] - mean[col - 1]) * 0.03125f;
            const float south =
                (3.0f * (step[col - 1] + step[col + 1]) + 10.0f * step[col]) * 0.03125f;
            real[at + col] = east * east - south * south;
            imaginary[at + col] = 2.0f * (east * south);
            magnitude[at + col] = sqrtf(east * east + south * south);
        }
        if (counts)
            for (int col = 0; col < cols; col++) magnitude[at + col] *= counts[at + col];
    }
}

/* The four planes of channels. */
INLINE void channels_inline(const picture_t *with, const recipe_t *recipe, float *restrict out) {
    const size_t pixels = (size_t)with->rows * with->cols;
    float *const picture = with->memory, *const one = picture + pixels, *const two = one + pixels;
    float *const three = two + pixels, *const room = three + pixels, *const counts = out + 3 * pixels;
    const float *const share = with->valid ? room : NULL;
    for (size_t i = 0; i < pixels; i++) picture[i] = (float)with->grey[i];
    if (share) {
        eroded(with, (int)ceil(2 * recipe->sigma), counts);
        for (size_t i = 0; i < pixels; i++) room[i] = with->valid[i] ? 1.0f : 0.0f;
        for (size_t i = 0; i < pixels; i++) one[i] = picture[i] * room[i];
        local_mean(with, one, share, recipe->deviation, three, two);
        for (size_t i = 0; i < pixels; i++) picture[i] = with->valid[i] ? picture[i] : two[i];
    } else
        for (size_t i = 0; i < pixels; i++) counts[i] = 1.0f;
    /* Gradients. */
    blurred(with, picture, recipe->sigma, one, two);
    differentiated(with, two, share ? counts : NULL, out, out + pixels, one);
    local_mean(with, one, share, recipe->contrast, three, two);
    for (size_t i = 0; i < pixels; i++) {
        const float size = one[i];
        const float weight = size / ((size + two[i] + GRADIENT_FLOOR) * (size * size + 1e-6f));
        out[i] *= weight, out[pixels + i] *= weight;
    }
    /* Grey without local mean, divided by the local deviation. */
    if (share)
        for (size_t i = 0; i < pixels; i++) one[i] = picture[i] * room[i];
    local_mean(with, share ? one : picture, share, recipe->mean, three, two);
    for (size_t i = 0; i < pixels; i++) picture[i] -= two[i];
    if (share)
        for (size_t i = 0; i < pixels; i++) picture[i] *= room[i];
    for (size_t i = 0; i < pixels; i++) one[i] = picture[i] * picture[i];
    local_mean(with, one, share, recipe->deviation, three, two);
    for (size_t i = 0; i < pixels; i++) {
        const float deviation = sqrtf(two[i] < 0.0f ? 0.0f : two[i]); /* sums may fall below */
        const float found = picture[i] / (deviation + DEVIATION_FLOOR);
        const float high = found > CLIP ? CLIP : found, bounded = high < -CLIP ? -CLIP : high;
        out[2 * pixels + i] = bounded * counts[i];
    }
}

FOR_EVERY_PROCESSOR(channels, (const picture_t *with, const recipe_t *recipe, float *out),
                    (with, recipe, out))

/* 0, or -1 without memory. */
static int make_channels(picture_t *with, const recipe_t *recipe, float *out) {
    const int side = recipe->contrast > recipe->deviation ? recipe->contrast : recipe->deviation;
    with->margin = (side > recipe->mean ? side : recipe->mean) / 2 + MOST_TAPS;
    const size_t line = (size_t)with->cols + 2 * (size_t)with->margin;
    with->memory = malloc(sizeof(float) * PLANES * (size_t)with->rows * with->cols);
    with->lines = malloc(sizeof(float) * LINES * line);
    const int failed = !with->memory || !with->lines;
    with->along = failed ? NULL : with->memory + (PLANES - 1) * (size_t)with->rows * with->cols;
    if (!failed) channels(with, recipe, out);
    free(with->memory), free(with->lines);
    return failed ? -1 : 0;
}

PyObject *py_channels(PyObject *self, PyObject *arguments) {
    PyObject *from[3];
    Py_buffer grey, valid = {0}, out;
    recipe_t recipe;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OO(diii)O", &from[0], &from[1], &recipe.sigma, &recipe.contrast,
                          &recipe.mean, &recipe.deviation, &from[2]))
        return NULL;
    const int sides[3] = {recipe.contrast, recipe.mean, recipe.deviation};
    for (int i = 0; i < 3; i++)
        if (sides[i] < 1 || sides[i] > LARGEST || sides[i] % 2 == 0 || !(recipe.sigma > 0) ||
            recipe.sigma > MOST_TAPS / 8 - 1) {
            PyErr_SetString(PyExc_ValueError, "windows must be odd and match the picture");
            return NULL;
        }
    if (borrow(from[0], &grey, 2, ANY, 'B', 0) < 0) return NULL;
    const int partly = from[1] != Py_None;
    if (partly && borrow(from[1], &valid, 2, grey.shape[1], '?', 0) < 0) goto free_grey;
    if (borrow(from[2], &out, 3, grey.shape[1], 'f', PyBUF_WRITABLE) < 0) goto free_valid;
    if (!is_whole(&grey) || !is_whole(&out) || (partly && !is_whole(&valid)) || out.shape[0] != LANES ||
        out.shape[1] != grey.shape[0] || (partly && valid.shape[0] != grey.shape[0]) ||
        grey.shape[0] < 1 || grey.shape[1] < 1 || grey.shape[0] > LARGEST || grey.shape[1] > LARGEST)
        PyErr_SetString(PyExc_ValueError, "grey, valid and channels do not match");
    else {
        picture_t with = {.grey = grey.buf, .valid = partly ? valid.buf : NULL,
                          .rows = (int)grey.shape[0], .cols = (int)grey.shape[1]};
        int failed;
        Py_BEGIN_ALLOW_THREADS
        failed = make_channels(&with, &recipe, out.buf);
        Py_END_ALLOW_THREADS
        if (failed) PyErr_NoMemory();
    }
    PyBuffer_Release(&out);
free_valid:
    if (partly) PyBuffer_Release(&valid);
free_grey:
    PyBuffer_Release(&grey);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}
