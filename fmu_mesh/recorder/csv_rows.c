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

#define PUBLIC __attribute__((visibility("default")))
#define SELDOM __attribute__((noinline))
#define UNLIKELY(condition) __builtin_expect(condition, 0)

typedef unsigned __int128 uint128_t;

enum { F64, F32, I8, U8, I16, U16, I32, U32, I64, U64, TRUTH }; /* types, as in burst.c */

typedef struct {
  uint64_t high, low;
} Factor;

enum { LEAST_POWER = -293, POWERS = 619, EXPONENTS = 2047, SPARE_BITS = 10, CELLS = 512 };

typedef struct {
  Factor powers[POWERS];    /* 10^n / 2^(floor(log2(10^n)) - 127), rounded down; the first is that of LEAST_POWER */
  Factor scales[EXPONENTS]; /* 2^q / 10^(k+1) * 2^128, rounded down; the first is that of q = -1075 */
} Tables;

typedef struct {
  const char *values;
  int64_t stride;
  int64_t type;
  uint64_t bits;    /* the last value */
  const char *text; /* where its text was first written, with the character after it; NULL: nowhere yet */
  int64_t size;     /* of this text */
} Column;

typedef struct { /* 0.ABC...PQ * 10^point: `first` has the 16 digits A to P, and A is not 0 */
  uint64_t first;
  int last;
  int point;
} Digits;

enum { PLUS, MINUS, HELD, OTHER }; /* kinds of cells */

typedef struct { /* what is known of a value before its text is written */
  uint64_t first; /* of its digits; the bits of an OTHER */
  int16_t point;
  uint8_t last;
  uint8_t kind;
} Cell;

static inline int floor_log10_pow2(int e) { return (e * 1262611) >> 22; }
static inline int floor_log10_three_quarters_pow2(int e) { return (e * 1262611 - 524031) >> 22; }
static inline int floor_log2_pow10(int e) { return (e * 1741647) >> 19; }

/* Fill the second table from the first. */
PUBLIC void csv_prepare(Tables *tables) {
  for (int q = -1075; q < EXPONENTS - 1075; q++) {
    const int n = -floor_log10_pow2(q) - 1;
    const Factor *power = &tables->powers[n - LEAST_POWER];
    const uint128_t scale = ((uint128_t)power->high << 64 | power->low) >> (-1 - q - floor_log2_pow10(n));
    tables->scales[q + 1075] = (Factor){(uint64_t)(scale >> 64), (uint64_t)scale};
  }
}

/* ---- the shortest digits */

static const uint64_t E15 = 1000000000000000, E16 = 10000000000000000, HIDDEN_BIT = 1ull << 52;

/* value * power / 2^128, rounded to odd; Schubfach needs the power rounded up. */
static uint64_t times(const Factor *power, uint64_t value) {
  const uint64_t low = power->low + 1, high = power->high + (low == 0);
  const uint128_t product = (uint128_t)high * value + (uint64_t)((uint128_t)low * value >> 64);
  return (uint64_t)(product >> 64) | ((uint64_t)product > 1);
}

static Digits with_all_digits(uint64_t digits, int exponent) {
  int point = exponent + 17;
  for (; digits < E16; digits *= 10) point--;
  return (Digits){digits / 10, (int)(digits % 10), point};
}

static SELDOM Digits exact(const Tables *tables, uint64_t bits) {
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
static inline Digits nearest(const Tables *tables, uint64_t bits) {
  const uint64_t exponent = bits >> 52, c = (bits & (HIDDEN_BIT - 1)) | HIDDEN_BIT;
  const Factor scale = tables->scales[exponent];
  const uint64_t factor = c << SPARE_BITS;
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
  return (Digits){whole + ((whole * 9 + digit) & -(uint64_t)is_short), digit & (is_short - 1),
                  floor_log10_pow2((int)exponent - 1075) + 17 - is_short};
}

/* ---- text */

typedef struct { /* 16 characters in order, and the last one; `count` of the 17 are without the zeros at the end */
  uint64_t first, second;
  char last;
  int count;
} Text;

/* Split numbers in halves, until each is one digit: n / 10000 is n * 109951163 / 2^40, n / 100 is n * 5243 / 2^19, and
 * n / 10 is n * 6554 / 2^16, for all n that occur. The high half goes before the low half. */
#ifdef __SSE2__
static inline Text text_of(const Digits digits) {
  __m128i v = _mm_set_epi64x((int64_t)(digits.first % 100000000), (int64_t)(digits.first / 100000000)), high;
  high = _mm_srli_epi64(_mm_mul_epu32(v, _mm_set1_epi64x(109951163)), 40);
  v = _mm_or_si128(high, _mm_slli_epi64(_mm_sub_epi64(v, _mm_mul_epu32(high, _mm_set1_epi64x(10000))), 32));
  high = _mm_srli_epi16(_mm_mulhi_epu16(v, _mm_set1_epi16(5243)), 3);
  v = _mm_or_si128(high, _mm_slli_epi32(_mm_sub_epi16(v, _mm_mullo_epi16(high, _mm_set1_epi16(100))), 16));
  high = _mm_mulhi_epu16(v, _mm_set1_epi16(6554));
  v = _mm_or_si128(high, _mm_slli_epi16(_mm_sub_epi16(v, _mm_mullo_epi16(high, _mm_set1_epi16(10))), 8));
  const int zeros = _mm_movemask_epi8(_mm_cmpeq_epi8(v, _mm_setzero_si128()));
  v = _mm_or_si128(v, _mm_set1_epi8('0'));
  return (Text){(uint64_t)_mm_cvtsi128_si64(v), (uint64_t)_mm_cvtsi128_si64(_mm_unpackhi_epi64(v, v)),
                (char)('0' + digits.last), 32 - __builtin_clz((zeros ^ 0xffff) | (digits.last != 0) << 16)};
}
#else
/* The digits of a number below 10^8, one in each byte. Here n / 100 is n * 10486 / 2^20; n / 10 is n * 103 / 2^10. */
static inline uint64_t eight(uint64_t n) {
  n = (n << 32) - (n * 109951163 >> 40) * ((10000ull << 32) - 1);
  n = (n << 16) - ((n * 10486 >> 20) & 0x7f0000007f) * ((100 << 16) - 1);
  return (n << 8) - ((n * 103 >> 10) & 0xf000f000f000f) * ((10 << 8) - 1);
}

static inline Text text_of(const Digits digits) {
  const uint64_t zeros = 0x3030303030303030;
  const uint64_t first = eight(digits.first / 100000000), second = eight(digits.first % 100000000);
  const int without = second ? 16 - __builtin_clzll(second) / 8 : 8 - __builtin_clzll(first) / 8;
  return (Text){first | zeros, second | zeros, (char)('0' + digits.last), digits.last ? 17 : without};
}
#endif

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
static SELDOM char *put_far(char *out, const Text text, int point) {
  const int is_fixed = point > 0 && point <= 16, before = is_fixed ? point : 1;
  char all[17];
  memcpy(all, &text.first, 8);
  memcpy(all + 8, &text.second, 8);
  all[16] = text.last;
  memcpy(out, all, 16);
  out[before] = '.';
  memcpy(out + before + 1, all + before, (size_t)(17 - before));
  if (is_fixed) return out + 1 + (text.count > point ? text.count : point + 1);
  out += text.count + (text.count > 1);
  *out++ = 'e';
  if (point > 0) *out++ = '+';
  return put_signed(out, point - 1);
}

static inline char *put_digits(char *out, const Digits digits) {
  const Text text = text_of(digits);
  const int point = digits.point;
  if (point > 0 && point < 8) {
    const uint64_t whole = (1ull << 8 * point) - 1;
    const uint64_t begin = (text.first & whole) | (text.first & ~whole) << 8 | (uint64_t)'.' << 8 * point;
    memcpy(out + 1, &text.first, 8);
    memcpy(out + 9, &text.second, 8);
    out[17] = text.last;
    memcpy(out, &begin, 8);
    return out + 1 + (text.count > point ? text.count : point + 1);
  }
  if (point <= 0 && point > -5) {
    memcpy(out, "0.000000", 8);
    out += 2 - point;
    memcpy(out, &text.first, 8);
    memcpy(out + 8, &text.second, 8);
    out[16] = text.last;
    return out + text.count;
  }
  return put_far(out, text, point);
}

/* Zero, a power of two, a subnormal number, an infinite one, or none. */
static SELDOM char *put_special(char *out, const Tables *tables, uint64_t bits) {
  const uint64_t size = bits & INT64_MAX, infinite = 2047 * HIDDEN_BIT;
  if (size > infinite) return put(out, "nan", 3);
  *out = '-';
  out += bits >> 63;
  if (size == infinite) return put(out, "inf", 3);
  return size == 0 ? put(out, "0.0", 3) : put_digits(out, exact(tables, size));
}

/* ---- rows */

/* A value as 64 bits with the sign of its type; a float as one of 64 bits. */
static inline uint64_t load(const char *from, int64_t type) {
  switch (type) {
    case F32: {
      float value;
      memcpy(&value, from, 4);
      const double same = value;
      uint64_t bits;
      memcpy(&bits, &same, 8);
      return bits;
    }
    case I8: return (uint64_t)*(const int8_t *)from;
    case I16: { int16_t v; memcpy(&v, from, 2); return (uint64_t)v; }
    case U16: { uint16_t v; memcpy(&v, from, 2); return v; }
    case I32: { int32_t v; memcpy(&v, from, 4); return (uint64_t)v; }
    case U32: { uint32_t v; memcpy(&v, from, 4); return v; }
    case U8:
    case TRUTH: return *(const uint8_t *)from;
    default: { uint64_t v; memcpy(&v, from, 8); return v; }
  }
}

static SELDOM char *put_other(char *out, int64_t type, uint64_t bits) {
  switch (type) {
    case U8:
    case U16:
    case U32:
    case U64: return put_unsigned(out, bits);
    case TRUTH: return bits ? put(out, "true", 4) : put(out, "false", 5);
    default: return put_signed(out, (int64_t)bits);
  }
}

/* Read values of one column; the next of them are `step` cells apart. */
static inline void read_cells(Column *column, int64_t type, int64_t rows, const Tables *tables, Cell *cell,
                              int64_t step) {
  const char *from = column->values;
  uint64_t previous = column->text != NULL ? column->bits : ~load(from, type);
  for (int64_t row = 0; row < rows; row++, from += column->stride, cell += step) {
    const uint64_t bits = load(from, type), size = bits & INT64_MAX;
    if (bits == previous) {
      cell->kind = HELD;
      continue;
    }
    previous = bits;
    if (type > F32 || UNLIKELY(size - HIDDEN_BIT >= 2046 * HIDDEN_BIT || size % HIDDEN_BIT == 0)) {
      *cell = (Cell){bits, 0, 0, OTHER};
    } else {
      const Digits digits = nearest(tables, size);
      *cell = (Cell){digits.first, (int16_t)digits.point, (uint8_t)digits.last, (uint8_t)(bits >> 63)};
    }
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
  if (cell->kind != OTHER) {
    *out = '-';
    out = put_digits(out + cell->kind, (Digits){cell->first, cell->last, cell->point});
  } else {
    out = column->type <= F32 ? put_special(out, tables, cell->first) : put_other(out, column->type, cell->first);
  }
  *out++ = separator;
  column->size = out - column->text;
  return out;
}

/* Write rows of n columns as lines; returns their size. A value takes up to 25 bytes, and `out` needs 40 more behind
 * them. First the digits of many values, then their texts: in a short loop a processor does more at once than in a long
 * one. Instances with larger steps hold their values: the text of a value that has not changed is copied. */
PUBLIC int64_t csv_rows(Column *columns, int64_t n, int64_t rows, const Tables *tables, char *out) {
  char *const start = out;
  Cell cells[CELLS];
  const int64_t block = n < CELLS ? CELLS / n : 1;
  for (int64_t i = 0; i < n; i++) columns[i].text = NULL;
  for (int64_t row = 0; row < rows; row += block) {
    const int64_t count = rows - row < block ? rows - row : block;
    for (int64_t first = 0; first < n; first += CELLS) { /* more columns than cells: one row, and a part of it */
      const int64_t width = n - first < CELLS ? n - first : CELLS;
      for (int64_t i = 0; i < width; i++) {
        Column *column = &columns[first + i];
        if (column->type == F64)
          read_cells(column, F64, count, tables, cells + i, width);
        else
          read_cells(column, column->type, count, tables, cells + i, width);
      }
      const Cell *cell = cells;
      for (int64_t line = 0; line < count; line++)
        for (int64_t i = first; i < first + width; i++, cell++)
          out = put_cell(out, &columns[i], tables, cell, i + 1 < n ? ',' : '\n');
    }
  }
  return out - start;
}
