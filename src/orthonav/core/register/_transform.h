/* Fourier transform of eight sequences at once (Stockham), in vectors of one size.
 *
 * Included once for each size: VECTOR is a type of vector, OF_VECTOR(name) the name of what is made
 * for it. A vector has the same number of all eight sequences, or of four, which are then taken one
 * after the other: with AVX2 eight fit into a register, elsewhere four. */

#define AT_A_TIME ((int)(sizeof(VECTOR) / sizeof(float)))
#define numbers OF_VECTOR(numbers)
#define taken OF_VECTOR(taken)
#define put OF_VECTOR(put)
#define plus OF_VECTOR(plus)
#define minus OF_VECTOR(minus)
#define times OF_VECTOR(times)
#define times_i OF_VECTOR(times_i)
#define turned OF_VECTOR(turned)
#define butterfly OF_VECTOR(butterfly)
#define pass OF_VECTOR(pass)
#define transform OF_VECTOR(transform)

typedef struct {
    VECTOR re, im;
} numbers;

INLINE numbers taken(const float *from) {
    return (numbers){*(const VECTOR *)from, *(const VECTOR *)(from + WIDE)};
}
INLINE void put(float *to, numbers value) {
    *(VECTOR *)to = value.re, *(VECTOR *)(to + WIDE) = value.im;
}
INLINE numbers plus(numbers a, numbers b) { return (numbers){a.re + b.re, a.im + b.im}; }
INLINE numbers minus(numbers a, numbers b) { return (numbers){a.re - b.re, a.im - b.im}; }
INLINE numbers times(numbers a, float by) { return (numbers){a.re * by, a.im * by}; }
INLINE numbers times_i(numbers a, float by) { return (numbers){-a.im * by, a.re * by}; }
INLINE numbers turned(numbers a, const float *by) {
    return (numbers){a.re * by[0] - a.im * by[1], a.re * by[1] + a.im * by[0]};
}

/* Transform of 2, 3, 4 or 5 numbers, `apart` from each other. */
INLINE void butterfly(int factor, const float *from, int apart, numbers *out) {
    const size_t next = (size_t)apart * PAIR;
    const numbers a = taken(from), b = taken(from + next);
    if (factor == 2) {
        out[0] = plus(a, b), out[1] = minus(a, b);
    } else if (factor == 3) {
        const numbers c = taken(from + 2 * next), sum = plus(b, c), middle = plus(a, times(sum, -0.5f));
        const numbers side = times_i(minus(b, c), -0.866025403784438647f);
        out[0] = plus(a, sum), out[1] = plus(middle, side), out[2] = minus(middle, side);
    } else if (factor == 4) {
        const numbers c = taken(from + 2 * next), d = taken(from + 3 * next);
        const numbers even = plus(a, c), odd = minus(a, c), sum = plus(b, d);
        const numbers side = times_i(minus(b, d), -1.0f);
        out[0] = plus(even, sum), out[1] = plus(odd, side);
        out[2] = minus(even, sum), out[3] = minus(odd, side);
    } else {
        const float cos1 = 0.309016994374947424f, sin1 = -0.951056516295153572f;
        const float cos2 = -0.809016994374947424f, sin2 = -0.587785252292473129f;
        const numbers c = taken(from + 2 * next), d = taken(from + 3 * next), e = taken(from + 4 * next);
        const numbers near = plus(b, e), far = plus(c, d), x = minus(b, e), y = minus(c, d);
        const numbers middle1 = plus(a, plus(times(near, cos1), times(far, cos2)));
        const numbers middle2 = plus(a, plus(times(near, cos2), times(far, cos1)));
        const numbers side1 = plus(times_i(x, sin1), times_i(y, sin2));
        const numbers side2 = minus(times_i(x, sin2), times_i(y, sin1));
        out[0] = plus(a, plus(near, far));
        out[1] = plus(middle1, side1), out[4] = minus(middle1, side1);
        out[2] = plus(middle2, side2), out[3] = minus(middle2, side2);
    }
}

/* One pass: what `done` passes' factors multiply to, and `left` numbers between parts. */
INLINE void pass(int factor, int done, int left, const float *from, float *to,
                 const float *twiddles) {
    const size_t apart = (size_t)left * done * PAIR, next = (size_t)left * PAIR;
    numbers out[5];
    for (int k = 0; k < done; k++, from += next * factor, to += next) {
        const float *by = twiddles;
        for (int i = 0; i < left; i++) {
            const float *const here = from + (size_t)i * PAIR;
            float *const into = to + (size_t)i * PAIR;
            for (int part = 0; part < WIDE; part += AT_A_TIME) {
                butterfly(factor, here + part, left, out);
                put(into + part, out[0]);
                for (int j = 1; j < factor; j++)
                    put(into + part + apart * j, i ? turned(out[j], by + 2 * (j - 1)) : out[j]);
            }
            if (i) by += 2 * (factor - 1);
        }
    }
}

/* Transform `data`; it ends there or in `scratch`, which `ended` says. */
INLINE void transform(const plan_t *plan, pair_t *data, pair_t *scratch, pair_t **ended) {
    const float *twiddles = plan->twiddles;
    for (int at = 0, done = 1; at < plan->count; done *= plan->factors[at++]) {
        const int factor = plan->factors[at], left = plan->length / (done * factor);
        const float *const from = (const float *)data;
        float *const to = (float *)scratch;
        switch (factor) {
        case 2: pass(2, done, left, from, to, twiddles); break;
        case 3: pass(3, done, left, from, to, twiddles); break;
        case 4: pass(4, done, left, from, to, twiddles); break;
        default: pass(5, done, left, from, to, twiddles); break;
        }
        twiddles += 2 * (size_t)(factor - 1) * (left - 1);
        pair_t *const other = data;
        data = scratch, scratch = other;
    }
    *ended = data;
}

#undef AT_A_TIME
#undef numbers
#undef taken
#undef put
#undef plus
#undef minus
#undef times
#undef times_i
#undef turned
#undef butterfly
#undef pass
#undef transform
