/* What the files of the kernel share: vectors, one function for several processors, buffers. */

#ifndef ORTHONAV_KERNEL_H
#define ORTHONAV_KERNEL_H

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#define BLOCKS 6        /* blocks along a side of a view: orthonav.core.register.template.BLOCKS */
#define LANES 4         /* cosine and sine of the doubled direction, grey, valid or mask */
#define LARGEST 32768   /* longest side, px */
#define SHIFT 64        /* makes coordinates positive, so that truncation rounds down */
#define CHUNK 128       /* pixels of a row whose taps are found together */
#define ANY (-1)        /* length of a dimension */
#define INLINE static inline __attribute__((always_inline))

typedef float lanes __attribute__((vector_size(16)));
typedef float lanes_in_memory __attribute__((vector_size(16), aligned(4)));

/* Whether functions for AVX2 are used: where the processor has it, and ORTHONAV_NO_AVX2 is not set to
 * anything but an empty string. */
extern __attribute__((visibility("hidden"))) int has_avx2;

/* A function compiled for processors with AVX2 from the inline function FAST, and for all from PLAIN.
 * GCC's target_clones("arch=..") is no substitute: it asks for that very model of processor. */
#if defined(__x86_64__) && defined(__GNUC__)
#define FOR_AVX2_AND_ALL(NAME, FAST, PLAIN, PARAMETERS, ARGUMENTS)                                  \
    __attribute__((target("avx2,fma"))) static void NAME##_avx2 PARAMETERS { FAST ARGUMENTS; }      \
    static void NAME##_plain PARAMETERS { PLAIN ARGUMENTS; }                                        \
    static void NAME PARAMETERS {                                                                   \
        if (has_avx2) NAME##_avx2 ARGUMENTS;                                                        \
        else NAME##_plain ARGUMENTS;                                                                \
    }
#else
#define FOR_AVX2_AND_ALL(NAME, FAST, PLAIN, PARAMETERS, ARGUMENTS)                                  \
    static void NAME PARAMETERS { PLAIN ARGUMENTS; }
#endif

/* The same from `NAME_inline`. */
#define FOR_EVERY_PROCESSOR(NAME, PARAMETERS, ARGUMENTS)                                            \
    FOR_AVX2_AND_ALL(NAME, NAME##_inline, NAME##_inline, PARAMETERS, ARGUMENTS)

INLINE lanes all(float value) { return (lanes){value, value, value, value}; }

INLINE lanes load(const float *from) { return *(const lanes_in_memory *)from; }

INLINE int below(float value) { return (int)(value + SHIFT) - SHIFT; }

typedef struct {
    const float *first;     /* evidence (R, C, 4) */
    Py_ssize_t stride;      /* floats from row to row */
    int rows, cols;
} window_t;

INLINE lanes tap(const window_t *window, int row, int col) {
    if (row < 0 || col < 0 || row >= window->rows || col >= window->cols) return all(0.0f);
    return load(window->first + row * window->stride + LANES * col);
}

/* Evidence at column x and row y, counted from pixel centres, bilinear; zero beyond the window. */
INLINE lanes sampled(const window_t *window, float x, float y) {
    if (!(x > -2.0f && y > -2.0f && x < (float)window->cols + 1.0f && y < (float)window->rows + 1.0f))
        return all(0.0f);
    const int col = below(x), row = below(y);
    const lanes a = tap(window, row, col), b = tap(window, row, col + 1);
    const lanes c = tap(window, row + 1, col), d = tap(window, row + 1, col + 1);
    const float right = x - (float)col, down = y - (float)row;
    const lanes top = a + right * (b - a), bottom = c + right * (d - c);
    return top + down * (bottom - top);
}

typedef struct {
    int offset[CHUNK];          /* of the upper left tap, floats from the first */
    float right[CHUNK], below[CHUNK];
} taps_t;

/* As `sampled`, where all four taps are inside. */
INLINE lanes inside(const float *at, Py_ssize_t stride, float right, float down) {
    const lanes upper = load(at), lower = load(at + stride);
    const lanes next = load(at + LANES), last = load(at + stride + LANES);
    const lanes left_side = upper + down * (lower - upper), right_side = next + down * (last - next);
    return left_side + right * (right_side - left_side);
}

/* Taps of `count` pixels of a row from (x, y); whether all of them are inside the window. */
INLINE int find_taps(const window_t *window, float x, float y, float dx, float dy, int count,
                     taps_t *taps) {
    const float end_x = x + dx * (float)(count - 1), end_y = y + dy * (float)(count - 1);
    const float last_x = (float)window->cols - 1.001f, last_y = (float)window->rows - 1.001f;
    if (!(x >= 0.001f && y >= 0.001f && end_x >= 0.001f && end_y >= 0.001f && x <= last_x &&
          y <= last_y && end_x <= last_x && end_y <= last_y))
        return 0;
    const int stride = (int)window->stride;
    for (int i = 0; i < count; i++) {
        const float at_x = x + dx * (float)i, at_y = y + dy * (float)i;
        const int col = (int)at_x, row = (int)at_y;
        taps->offset[i] = row * stride + LANES * col;
        taps->right[i] = at_x - (float)col;
        taps->below[i] = at_y - (float)row;
    }
    return 1;
}

/* Borrow a buffer of numbers of 'f', 'd', 'i', 'B' or '?' with so many dimensions, the last of `last` numbers
 * (or `ANY`) that lie together; 0, or -1 with an error. */
int borrow(PyObject *from, Py_buffer *into, int dimensions, Py_ssize_t last, char kind, int flags);

/* Whether all numbers of a buffer lie together. */
int is_whole(const Py_buffer *buffer);

PyObject *py_blocks(PyObject *self, PyObject *arguments);
PyObject *py_bend(PyObject *self, PyObject *arguments);
PyObject *py_channels(PyObject *self, PyObject *arguments);
PyObject *py_thin(PyObject *self, PyObject *arguments);
PyObject *py_rectify(PyObject *self, PyObject *arguments);
PyObject *py_search(PyObject *self, PyObject *arguments);
PyObject *py_near(PyObject *self, PyObject *arguments);
PyObject *py_moved(PyObject *self, PyObject *arguments);

#endif
