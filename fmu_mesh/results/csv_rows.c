/* Rows of numbers as lines of a CSV file.
 *
 * A float has the smallest number of digits that gives the same bits when it is read, and of these digits the nearest
 * to its value. Two functions find them, and they use the same notation: v = c * 2^q, and 10^k <= 2^q < 10^(k+1).
 *
 *   exact     Schubfach (R. Giulietti, "The Schubfach way to render doubles", 2020), for all floats.
 *   nearest   has a third of its multiplications: v / 10^(k+1) as an integer and a fraction of 64 bits. Both are too
 *             low by less than 2 units of 2^-64. Where such an error could change a digit, `exact` finds the digits:
 *             by chance once in 2^57 floats, and for some integers above 2^53.
 *
 * csv_file.py has a second implementation, for machines without this library.
 */
#include <stdint.h>
#include <string.h>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the first character of a text is the lowest byte of a word here"
#endif

#define SELDOM __attribute__((noinline))
#define UNLIKELY(condition) __builtin_expect(condition, 0)

typedef unsigned __int128 uint128_t;

typedef struct {
  uint64_t low, high;
} Factor;

typedef struct {
  Factor powers[619];  /* 10^n / 2^(floor(log2(10^n)) - 127), rounded down; the first is that of LEAST_POWER */
  Factor scales[2047]; /* 2^q / 10^(k+1) * 2^128, rounded down; the first is that of q = -1075 */
} Tables;

typedef struct {
  const char *values; /* of 64 bits; a Boolean has 8 */
  int64_t stride;
  int64_t type;     /* as in NumPy: f, i, u or b */
  uint64_t bits;    /* the last value */
  const char *text; /* where its text was first written, with the character after it */
  int64_t size;     /* of this text */
} Column;

enum { PLUS, MINUS, HELD, OTHER }; /* kinds of cells */

typedef struct { /* a value before its text is written; a PLUS or MINUS is 0.ABC...PQ * 10^point, and A is not 0 */
  uint64_t first; /* the 16 digits A to P; the bits of an OTHER */
  int16_t point;
  uint8_t last; /* the digit Q */
  uint8_t kind;
} Cell;

enum { LEAST_POWER = -293, SPARE_BITS = 10 };
static const uint64_t E15 = 1000000000000000, E16 = 10000000000000000, HIDDEN_BIT = 1ull << 52;

static inline int floor_log10_pow2(int e) { return (e * 1262611) >> 22; }
static inline int floor_log10_three_quarters_pow2(int e) { return (e * 1262611 - 524031) >> 22; }
static inline int floor_log2_pow10(int e) { return (e * 1741647) >> 19; }

static inline uint64_t bits_at(const char *value) {
  uint64_t bits;
  memcpy(&bits, value, 8);
  return bits;
}

/* ---- the shortest digits */

/* value * power / 2^128, rounded to odd; Schubfach needs the power rounded up. */
static uint64_t times(const Factor *power, uint64_t value) {
  const uint64_t low = power->low + 1, high = power->high + (low == 0);
  const uint128_t product = (uint128_t)high * value + (uint64_t)((uint128_t)low * value >> 64);
  return (uint64_t)(product >> 64) | ((uint64_t)product > 1);
}

static Cell with_all_digits(uint64_t digits, int exponent) {
  int point = exponent + 17;
  for (; digits < E16; digits *= 10) point--;
  return (Cell){digits / 10, (int16_t)point, (uint8_t)(digits % 10), PLUS};
}

static SELDOM Cell exact(const Tables *tables, uint64_t bits) {
  const int exponent = (int)(bits >> 52), q = (exponent ? exponent : 1) - 1075;
  const uint64_t mantissa = bits & (HIDDEN_BIT - 1), c = exponent ? mantissa | HIDDEN_BIT : mantissa;
  const int is_closer_below = mantissa == 0 && exponent > 1; /* the next lower float */
  const int k = is_closer_below ? floor_log10_three_quarters_pow2(q) : floor_log10_pow2(q);
  const int shift = q + floor_log2_pow10(-k) + 1, is_odd = c & 1;
  const Factor *power = &tables->powers[-k - LEAST_POWER];
  /* Four times the value, and the ends of the interval that is read as the same float, in units of 10^k. */
  const uint64_t lower = times(power, (4 * c - 2 + is_closer_below) << shift) + is_odd;
  const uint64_t value = times(power, 4 * c << shift);
  const uint64_t upper = times(power, (4 * c + 2) << shift) - is_odd;
  const uint64_t digits = value / 4, fewer = digits / 10;
  if (fewer > 0) {
    const int below = lower <= 40 * fewer, above = 40 * fewer + 40 <= upper;
    if (below != above) return with_all_digits(fewer + above, k + 1);
  }
  const int below = lower <= 4 * digits, above = 4 * digits + 4 <= upper;
  if (below != above) return with_all_digits(digits + above, k);
  const uint64_t middle = 4 * digits + 2;
  return with_all_digits(digits + (value > middle || (value == middle && (digits & 1))), k);
}

/* The digits of a positive float that is neither subnormal nor a power of two. */
static inline Cell nearest(const Tables *tables, uint64_t bits) {
  const uint64_t exponent = bits >> 52, factor = ((bits & (HIDDEN_BIT - 1)) | HIDDEN_BIT) << SPARE_BITS;
  const Factor scale = tables->scales[exponent];
  const uint128_t product = (uint128_t)scale.high * factor + (uint64_t)((uint128_t)scale.low * factor >> 64);
  const uint64_t fraction = (uint64_t)(product >> SPARE_BITS);
  const uint64_t half = scale.high >> 1; /* of the distance to the next float */
  const uint128_t tenths = (uint128_t)fraction * 10 + (1ull << 63);
  if (UNLIKELY(fraction - half + 4 < 9 || fraction + half + 4 < 9 || (uint64_t)tenths + 32 < 33))
    return exact(tables, bits);
  const int above = fraction + half < fraction, below = half > fraction;
  const uint64_t whole = (uint64_t)(product >> (64 + SPARE_BITS)) + above;
  /* No branches: the next two cases are as likely as not. */
  const int digit = (int)(tenths >> 64) & ((above | below) - 1);
  const int is_short = whole < E15;
  const int point = floor_log10_pow2((int)exponent - 1075) + 17 - is_short;
  return (Cell){whole + ((whole * 9 + digit) & -(uint64_t)is_short), (int16_t)point, (uint8_t)(digit & (is_short - 1)),
                PLUS};
}

/* ---- text */

static inline char *put(char *out, const void *text, size_t size) {
  memcpy(out, text, size);
  return out + size;
}

static inline char *put_unsigned(char *out, uint64_t value) {
  char text[20], *first = text + 20;
  do *--first = (char)('0' + value % 10);
  while (value /= 10);
  return put(out, first, (size_t)(text + 20 - first));
}

static inline char *put_signed(char *out, int64_t value) {
  *out = '-';
  return put_unsigned(out + (value < 0), value < 0 ? -(uint64_t)value : (uint64_t)value);
}

/* A number from 10^7 on, or below 10^-5. */
static SELDOM char *put_far(char *out, const char *text, int count, int point) {
  const int is_fixed = point > 0 && point <= 16, before = is_fixed ? point : 1;
  memcpy(out + 1, text, 17);
  memcpy(out, text, (size_t)before);
  out[before] = '.';
  if (is_fixed) return out + 1 + (count > point ? count : point + 1);
  out += count + (count > 1);
  *out++ = 'e';
  if (point > 0) *out++ = '+';
  return put_signed(out, point - 1);
}

/* Write all 17 digits; returns how many they are without the zeros at the end. */
static inline int digits_of(Cell cell, char *text) {
  const uint64_t n = cell.first;
  text[16] = (char)('0' + cell.last);
#ifdef __SSE2__
  /* Split n in halves until each is one digit; the high half goes before the low one. n / 10000 is
   * n * 109951163 / 2^40, n / 100 is n * 5243 / 2^19, and n / 10 is n * 6554 / 2^16, for all n that occur. */
  __m128i v = _mm_set_epi64x((int64_t)(n % 100000000), (int64_t)(n / 100000000)), high;
  high = _mm_srli_epi64(_mm_mul_epu32(v, _mm_set1_epi64x(109951163)), 40);
  v = _mm_or_si128(high, _mm_slli_epi64(_mm_sub_epi64(v, _mm_mul_epu32(high, _mm_set1_epi64x(10000))), 32));
  high = _mm_srli_epi16(_mm_mulhi_epu16(v, _mm_set1_epi16(5243)), 3);
  v = _mm_or_si128(high, _mm_slli_epi32(_mm_sub_epi16(v, _mm_mullo_epi16(high, _mm_set1_epi16(100))), 16));
  high = _mm_mulhi_epu16(v, _mm_set1_epi16(6554));
  v = _mm_or_si128(high, _mm_slli_epi16(_mm_sub_epi16(v, _mm_mullo_epi16(high, _mm_set1_epi16(10))), 8));
  _mm_storeu_si128((__m128i *)text, _mm_or_si128(v, _mm_set1_epi8('0')));
  const int zeros = _mm_movemask_epi8(_mm_cmpeq_epi8(v, _mm_setzero_si128()));
  return 32 - __builtin_clz((zeros ^ 0xffff) | (cell.last != 0) << 16);
#else
  int count = cell.last ? 17 : 0;
  uint64_t rest = n;
  for (int i = 16; i > 0; rest /= 10) {
    if (count == 0 && rest % 10 > 0) count = i;
    text[--i] = (char)('0' + rest % 10);
  }
  return count;
#endif
}

static inline char *put_digits(char *out, Cell cell) {
  char text[17];
  const int count = digits_of(cell, text), point = cell.point;
  const uint64_t head = bits_at(text);
  *out = '-';
  out += cell.kind;
  if (point > 0 && point < 8) {
    const uint64_t whole = (1ull << 8 * point) - 1;
    const uint64_t begin = (head & whole) | (head & ~whole) << 8 | (uint64_t)'.' << 8 * point;
    put(out + 1, text, 17);
    memcpy(out, &begin, 8);
    return out + 1 + (count > point ? count : point + 1);
  }
  if (point > 0 || point <= -5) return put_far(out, text, count, point);
  out = put(out, "0.000000", 8) - 6 - point;
  memcpy(out, text, 17);
  return out + count;
}

/* An integer, a Boolean, or a float that is zero, a power of two, subnormal, infinite, or none. */
static SELDOM char *put_other(char *out, const Tables *tables, int64_t type, uint64_t bits) {
  const uint64_t size = bits & INT64_MAX, infinite = 2047 * HIDDEN_BIT;
  if (type == 'i') return put_signed(out, (int64_t)bits);
  if (type == 'u') return put_unsigned(out, bits);
  if (type == 'b') return bits ? put(out, "true", 4) : put(out, "false", 5);
  if (size > infinite) return put(out, "nan", 3);
  *out = '-';
  out += bits >> 63;
  if (size == infinite) return put(out, "inf", 3);
  return size == 0 ? put(out, "0.0", 3) : put_digits(out, exact(tables, size));
}

/* ---- rows */

/* Read values of one column; the next of them are `step` cells apart. */
static inline void read_cells(Column *column, int64_t rows, const Tables *tables, Cell *cell, int64_t step) {
  uint64_t previous = column->bits;
  const char *from = column->values;
  const int64_t stride = column->stride, type = column->type;
  for (int64_t row = 0; row < rows; row++, from += stride, cell += step) {
    const uint64_t bits = bits_at(from), size = bits & INT64_MAX;
    if (bits == previous) {
      cell->kind = HELD;
    } else if (type != 'f' || UNLIKELY(size - HIDDEN_BIT >= 2046 * HIDDEN_BIT || size % HIDDEN_BIT == 0)) {
      *cell = (Cell){bits, 0, 0, OTHER};
    } else {
      const Cell digits = nearest(tables, size);
      *cell = (Cell){digits.first, digits.point, digits.last, (uint8_t)(bits >> 63)};
    }
    previous = bits;
  }
  column->values = from;
  column->bits = previous;
}

static inline char *put_cell(char *out, Column *column, const Tables *tables, const Cell *cell, char separator) {
  if (cell->kind == HELD) {
    memmove(out, column->text, 32); /* what follows the text is written over; in a short line the two overlap */
    return out + column->size;
  }
  column->text = out;
  out = cell->kind == OTHER ? put_other(out, tables, column->type, cell->first) : put_digits(out, *cell);
  *out++ = separator;
  column->size = out - column->text;
  return out;
}

/* Write rows of n columns as lines; returns their size. A value takes up to 25 bytes, and `out` needs 40 more behind
 * them. First the digits of many values, then their texts: in a short loop a processor does more at once than in a long
 * one. Instances with larger steps hold their values: the text of a value that has not changed is copied. `cells` has
 * room for so many values, at least for those of one row. */
__attribute__((visibility("default"))) int64_t csv_rows(Column *columns, int64_t n, int64_t rows, const Tables *tables,
                                                        Cell *cells, int64_t room, char *out) {
  char *const start = out;
  const int64_t block = room / n;
  for (int64_t i = 0; i < n; i++) columns[i].bits = ~bits_at(columns[i].values); /* there is no text to copy yet */
  for (int64_t row = 0; row < rows; row += block) {
    const int64_t count = rows - row < block ? rows - row : block;
    for (int64_t i = 0; i < n; i++) read_cells(&columns[i], count, tables, cells + i, n);
    const Cell *cell = cells;
    for (int64_t line = 0; line < count; line++)
      for (int64_t i = 0; i < n; i++, cell++)
        out = put_cell(out, &columns[i], tables, cell, i + 1 < n ? ',' : '\n');
  }
  return out - start;
}
