/* Pictures made smaller, and rectified: orthonav.core.localize.view, compiled. */

#include "_kernel.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LARGEST_FACTOR 256  /* whose sums of columns fit into 16 bits */

/* Mean over squares of `factor` pixels, as OpenCV rounds it; `sums`: room for a row. */
INLINE void thin_inline(const unsigned char *from, size_t stride, int factor, int rows, int cols,
                        unsigned short *restrict sums, unsigned char *restrict to) {
    const float share = 1.0f / (float)(factor * factor);
    for (int row = 0; row < rows; row++, to += cols) {
        memset(sums, 0, sizeof *sums * (size_t)cols * factor);
        for (int i = 0; i < factor; i++, from += stride)
            for (int col = 0; col < cols * factor; col++) sums[col] += from[col];
        for (int col = 0; col < cols; col++) {
            int total = 0;
            for (int i = 0; i < factor; i++) total += sums[col * factor + i];
            to[col] = (unsigned char)rintf((float)total * share);
        }
    }
}

FOR_EVERY_PROCESSOR(thin,
                    (const unsigned char *from, size_t stride, int factor, int rows, int cols,
                     unsigned short *sums, unsigned char *to),
                    (from, stride, factor, rows, cols, sums, to))

PyObject *py_thin(PyObject *self, PyObject *arguments) {
    PyObject *from, *to;
    Py_buffer grey, out;
    int factor;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OiO", &from, &factor, &to)) return NULL;
    if (borrow(from, &grey, 2, ANY, 'B', 0) < 0) return NULL;
    if (borrow(to, &out, 2, ANY, 'B', PyBUF_WRITABLE) < 0) goto free_grey;
    if (factor < 1 || factor > LARGEST_FACTOR || !is_whole(&out) || out.shape[0] < 1 ||
        out.shape[1] < 1 || out.shape[0] != grey.shape[0] / factor ||
        out.shape[1] != grey.shape[1] / factor || grey.strides[0] < 0 || grey.shape[1] > INT_MAX)
        PyErr_SetString(PyExc_ValueError, "picture, factor and result do not match");
    else {
        unsigned short *const sums = malloc(sizeof *sums * (size_t)grey.shape[1]);
        Py_BEGIN_ALLOW_THREADS
        if (sums)
            thin(grey.buf, (size_t)grey.strides[0], factor, (int)out.shape[0], (int)out.shape[1],
                 sums, out.buf);
        Py_END_ALLOW_THREADS
        if (!sums) PyErr_NoMemory();
        free(sums);
    }
    PyBuffer_Release(&out);
free_grey:
    PyBuffer_Release(&grey);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

#define NODE_PX 4       /* pixels of a window between nodes: orthonav.core.localize.view.NODE_PX */

typedef struct {
    const unsigned char *grey;
    size_t stride;
    int rows, cols;
} grey_t;

/* Nodes (.., cols, 2): where they lie in a picture, from pixel centres, NaN where not usable. */
typedef struct {
    const float *first;
    int cols;
} nodes_t;

/* Between two numbers; the other one does not matter where the share is 0, also if it is NaN. */
INLINE float between(float one, float other, float share) {
    return share > 0 ? one + share * (other - one) : one;
}

/* Grey of a picture at x and y, bilinear; beyond its outer pixel centres that of its border. */
INLINE unsigned char grey_at(const grey_t *from, float x, float y) {
    const float left = floorf(x), top = floorf(y);
    const int col = (int)left, row = (int)top;
    const int c0 = col < 0 ? 0 : col, c1 = col + 1 < from->cols ? col + 1 : from->cols - 1;
    const int r0 = row < 0 ? 0 : row, r1 = row + 1 < from->rows ? row + 1 : from->rows - 1;
    const unsigned char *const upper = from->grey + from->stride * r0;
    const unsigned char *const lower = from->grey + from->stride * r1;
    const float right = x - left, down = y - top;
    const float a = (float)upper[c0] + right * (float)(upper[c1] - upper[c0]);
    const float b = (float)lower[c0] + right * (float)(lower[c1] - lower[c0]);
    return (unsigned char)(a + down * (b - a) + 0.5f);
}

/* Grey and valid of a window (rows, cols) by its nodes; `line`: room for a row of nodes. */
INLINE void rectify_inline(const grey_t *from, const nodes_t *nodes, int rows, int cols,
                           float *restrict line, unsigned char *restrict grey,
                           unsigned char *restrict valid) {
    const float last_x = (float)from->cols - 0.5f, last_y = (float)from->rows - 0.5f;
    const size_t width = 2 * (size_t)nodes->cols;
    for (int row = 0; row < rows; row++, grey += cols, valid += cols) {
        const float *const upper = nodes->first + width * (row / NODE_PX);
        const float down = (float)(row % NODE_PX) / NODE_PX;
        for (size_t i = 0; i < width; i++) line[i] = between(upper[i], upper[width + i], down);
        for (int col = 0; col < cols; col++) {
            const float *const at = line + 2 * (col / NODE_PX);
            const float right = (float)(col % NODE_PX) / NODE_PX;
            const float x = between(at[0], at[2], right), y = between(at[1], at[3], right);
            const int seen = x >= -0.5f && y >= -0.5f && x <= last_x && y <= last_y;
            valid[col] = (unsigned char)seen;
            grey[col] = seen ? grey_at(from, x, y) : 0;
        }
    }
}

FOR_EVERY_PROCESSOR(rectify,
                    (const grey_t *from, const nodes_t *nodes, int rows, int cols, float *line,
                     unsigned char *grey, unsigned char *valid),
                    (from, nodes, rows, cols, line, grey, valid))

PyObject *py_rectify(PyObject *self, PyObject *arguments) {
    PyObject *from[4];
    Py_buffer picture, nodes, grey, valid;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "OOOO", &from[0], &from[1], &from[2], &from[3])) return NULL;
    if (borrow(from[0], &picture, 2, ANY, 'B', 0) < 0) return NULL;
    if (borrow(from[1], &nodes, 3, 2, 'f', 0) < 0) goto free_picture;
    if (borrow(from[2], &grey, 2, ANY, 'B', PyBUF_WRITABLE) < 0) goto free_nodes;
    if (borrow(from[3], &valid, 2, ANY, '?', PyBUF_WRITABLE) < 0) goto free_grey;
    const Py_ssize_t rows = grey.shape[0], cols = grey.shape[1];
    if (!is_whole(&nodes) || !is_whole(&grey) || !is_whole(&valid) || rows != valid.shape[0] ||
        cols != valid.shape[1] || rows < 1 || cols < 1 || rows > LARGEST || cols > LARGEST ||
        picture.shape[0] < 1 || picture.shape[1] < 1 || picture.strides[0] < 0 ||
        picture.shape[0] > USHRT_MAX || picture.shape[1] > USHRT_MAX ||
        nodes.shape[0] < (rows - 1) / NODE_PX + 2 || nodes.shape[1] < (cols - 1) / NODE_PX + 2 ||
        nodes.shape[1] > LARGEST)
        PyErr_SetString(PyExc_ValueError, "picture, nodes and window do not match");
    else {
        const grey_t taken = {picture.buf, (size_t)picture.strides[0], (int)picture.shape[0],
                              (int)picture.shape[1]};
        const nodes_t at = {nodes.buf, (int)nodes.shape[1]};
        float *const line = malloc(sizeof *line * 2 * (size_t)nodes.shape[1]);
        Py_BEGIN_ALLOW_THREADS
        if (line) rectify(&taken, &at, (int)rows, (int)cols, line, grey.buf, valid.buf);
        Py_END_ALLOW_THREADS
        if (!line) PyErr_NoMemory();
        free(line);
    }
    PyBuffer_Release(&valid);
free_grey:
    PyBuffer_Release(&grey);
free_nodes:
    PyBuffer_Release(&nodes);
free_picture:
    PyBuffer_Release(&picture);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}
