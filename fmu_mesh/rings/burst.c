/* The burst: a node steps its instances as far as inputs, windows and the grant allow, in one call.
 *
 * Everything here is driven by tables that Python fills (`burst.h` declares them). One value passes from the row of
 * its source into the input of its target, and the outputs are read into a row of the own ring.
 *
 * Threads and processes. `node_run` is called by the main thread of a node, without the lock of the interpreter;
 * several nodes run it at the same time over one memory, and a process that is killed may stop at any instruction. Of
 * one node:
 *
 *   node_run, member_step               the main thread only; nobody else writes its tables meanwhile
 *   node_attend, ring_bell              any thread of the process: they set one flag and one bell
 *   counter_raise                       the one thread that raises this counter
 *   counter_value, bell_seen, sleep_for each participant for itself: one thread that sleeps
 *   grant_withdraw                      the master
 *   run_with_python                     as node_run, by a thread that has the lock: it lets go of it, except in calls of Python
 *   copies_work, copies_serve           the thread of these copies, which alone calls their FMUs (see Worker)
 *
 * What may go wrong: a peer writes garbage into the memory (a value never comes of it, see Rows), a peer is killed
 * between a value and its bell (a sleeper loses its time limit once), a model changes the floating-point mode (it is
 * set back after each step), a value does not fit into its type (the burst ends, and Python makes the error), a model
 * never returns (only other threads can tell it). A crash of a model ends this process; the others go on with the
 * rows that it has counted.
 *
 * Tried or considered, and given up: messages and semaphores between processes (ADR 5), code for each model (LLVM: slower
 * to start, 170 MB, and nobody can check it; ADR 57), a fence after each row (a good part of a point of the fastest
 * chain, see docs/rings.md), waiting without spinning (a sleeper on another core needs 50 us to wake up), and
 * spinning without an end (two processes on one core). ADR 58 has the decision.
 *
 * Rows. Row n of a ring is in slot n & mask. A row begins with its stamp, n + 1. The writer clears the stamp, writes
 * the values, writes the stamp, and then counts the row (release). A reader looks at the counter (acquire), and at
 * the stamp before and after it has read: a counter that is wrong, or a row that was overwritten, never becomes a
 * value.
 *
 * Waiting. A counter has one writer and only grows; only a pause lowers the grant. Who waits for it spins, yields,
 * and then sleeps on its own bell:
 *
 *   sleeper:  seen = bell; need = goal; lower wake_at; FENCE; counter >= goal? otherwise futex_wait(bell, seen)
 *   writer:   counter = value; FENCE; wake_at <= value? then for each need that is met: clear it (compare and swap),
 *             bell += 1, futex_wake(bell)
 *
 * Of the two, at least one sees what the other has written before its fence. Within a burst the writer looks at
 * wake_at without the fence: a sleeper that it misses is seen after the next step. With the fence it looks at the end
 * of a burst and before it waits itself. Every sleep has a time limit. docs/rings.md explains the protocol;
 * tests/property/test_waiting.py explores it.
 *
 * Memory orders. Each access of an atomic names its order, because ARM delays what x86 does not (the compiler refuses
 * implicit accesses, and tests/unit/test_library.py the functions without an order):
 *
 *   release, acquire   a number, and what was written before it: counters, stamps, states
 *   seq_cst            two sides that each store, and then load what the other one stores: wake_at, needs, bells
 *   relaxed            a fence is beside it, or the number only says when to look again
 */
#define _GNU_SOURCE
#include <fenv.h>
#include <stddef.h>
#include <string.h>

#include "counters.h"

enum { WARNING = 1, OUT_OF_RANGE = 100, WRONG_ROW = 101, STAGE_BITS = 24 }; /* statuses, and where the stage begins */

/* ---- waiting */

PUBLIC void ring_bell(Bell *bell) { ring(bell); }

/* Raise a counter, and wake who needs it: for Python. */
PUBLIC void counter_raise(const Place *place, Counter *counter, int64_t value) {
  if (value <= atomic_load_explicit(&counter->value, memory_order_relaxed)) return; /* only this thread raises it */
  atomic_store_explicit(&counter->value, value, memory_order_release);
  atomic_thread_fence(memory_order_seq_cst);
  wake_if_needed(place, counter);
}

/* Take the grant back, and return a point that no node passes without a new one: the master grants it at once, so all
 * pause there. A node claims, has a fence, and reads the grant; this is the other side. */
PUBLIC int64_t grant_withdraw(Counter *grant, Counter *const *nodes, int64_t n) {
  int64_t most = 0;
  atomic_store_explicit(&grant->value, 0, memory_order_relaxed);
  atomic_thread_fence(memory_order_seq_cst);
  for (int64_t i = 0; i < n; i++) {
    int64_t claimed = atomic_load_explicit(&nodes[i]->claimed, memory_order_relaxed);
    if (claimed > most) most = claimed;
  }
  return most;
}

PUBLIC int64_t counter_value(const Counter *counter) { return value_of(counter); }

/* Acquire: the reasons to stay awake are looked at after it, and were written before it was rung. */
PUBLIC uint32_t bell_seen(const Place *place) {
  return atomic_load_explicit(&place->bells[place->own].rung, memory_order_acquire);
}

/* ---- one step of one member */

/* Volatile only so that the compiler does not calculate with them: nobody writes them. */
static volatile const double ONE = 1.0, HALF_ULP = 0x1p-53, QUARTER_ULP = 0x1p-54, TINY = 0x1p-1074;

/* Whether a model has left the mode "round to nearest, subnormal numbers": each other mode changes one of these. */
static inline int mode_changed(void) {
  const double one = ONE;
  return one + HALF_ULP - QUARTER_ULP != one || TINY + TINY == 0.0;
}

/* An integer as 65 bits: the number, and whether it is above those of int64_t. */
static inline int64_t as_integer(const char *from, int type, int *large) {
  *large = 0;
  switch (type) {
    case I8: return *(const int8_t *)from;
    case U8: return *(const uint8_t *)from;
    case I16: { int16_t v; memcpy(&v, from, 2); return v; }
    case U16: { uint16_t v; memcpy(&v, from, 2); return v; }
    case I32: { int32_t v; memcpy(&v, from, 4); return v; }
    case U32: { uint32_t v; memcpy(&v, from, 4); return v; }
    case I64: { int64_t v; memcpy(&v, from, 8); return v; }
    case U64: { uint64_t v; memcpy(&v, from, 8); *large = v > INT64_MAX; return (int64_t)v; }
    default: return *(const uint8_t *)from != 0;
  }
}

static inline double as_double(const char *from, int type) {
  switch (type) {
    case F64: { double v; memcpy(&v, from, 8); return v; }
    case F32: { float v; memcpy(&v, from, 4); return v; }
    case U64: { uint64_t v; memcpy(&v, from, 8); return (double)v; }
    default: { int large; return (double)as_integer(from, type, &large); }
  }
}

static inline int put_integer(char *to, int type, int64_t v, int large) {
#define FITS(low, high) (!large && v >= (low) && v <= (high))
  switch (type) {
    case I8: { int8_t w = (int8_t)v; memcpy(to, &w, 1); return FITS(INT8_MIN, INT8_MAX); }
    case U8: { uint8_t w = (uint8_t)v; memcpy(to, &w, 1); return FITS(0, UINT8_MAX); }
    case I16: { int16_t w = (int16_t)v; memcpy(to, &w, 2); return FITS(INT16_MIN, INT16_MAX); }
    case U16: { uint16_t w = (uint16_t)v; memcpy(to, &w, 2); return FITS(0, UINT16_MAX); }
    case I32: { int32_t w = (int32_t)v; memcpy(to, &w, 4); return FITS(INT32_MIN, INT32_MAX); }
    case U32: { uint32_t w = (uint32_t)v; memcpy(to, &w, 4); return FITS(0, UINT32_MAX); }
    case I64: memcpy(to, &v, 8); return !large;
    case U64: memcpy(to, &v, 8); return large || v >= 0;
    default: *(uint8_t *)to = v != 0 || large; return 1;
  }
#undef FITS
}

static inline void put_double(char *to, int type, double v) {
  if (type == F64) {
    memcpy(to, &v, 8);
  } else {
    float w = (float)v; /* beyond the range: infinite, as in C */
    memcpy(to, &w, 4);
  }
}

static const int SIZES[] = {8, 4, 1, 1, 2, 2, 4, 4, 8, 8, 1};

/* Replace an integer by that of its entry, if it has one. Returns whether the input can be the result. */
static int look_up(const Lookup *lookup, int64_t *value, int *large) {
  int64_t low = 0, high = lookup->n_entries;
  while (low < high) {
    const int64_t middle = low + (high - low) / 2;
    const Entry *entry = &lookup->entries[middle];
    if (entry->from == *value && entry->from_large == *large) {
      *value = entry->to;
      *large = entry->to_large;
      break;
    }
    if (entry->from_large < *large || (entry->from_large == *large && entry->from < *value))
      low = middle + 1;
    else
      high = middle;
  }
  if (lookup->n_items == 0) return 1;
  if (*large) return 0;
  for (low = 0, high = lookup->n_items; low < high;) {
    const int64_t middle = low + (high - low) / 2, item = lookup->items[middle];
    if (item == *value) return 1;
    if (item < *value)
      low = middle + 1;
    else
      high = middle;
  }
  return 0;
}

/* Copy values, with factor and offset (one rounding each) or a map, and types. Returns 0, or OUT_OF_RANGE. */
static int move_values(const Move *move, const char *from, char *to) {
  const int from_type = move->from_type, to_type = move->to_type;
  const int64_t from_size = SIZES[from_type], to_size = SIZES[to_type];
  if (from_type == to_type && move->change == UNCHANGED && !move->negated) {
    if (move->count == 1 && from_size == 8)
      memcpy(to, from, 8);
    else
      memcpy(to, from, (size_t)(move->count * from_size));
    return 0;
  }
  if (move->count == 1 && from_type == F64 && to_type == F64 && move->change != UNCHANGED && !move->negated) {
    double value, before; /* as below, and several times as fast */
    memcpy(&value, from, 8);
    memcpy(&before, to, 8);
    value = value * move->factor + move->offset;
    if (move->change == ADDED) value = before + value;
    memcpy(to, &value, 8);
    return 0;
  }
  for (int64_t i = 0; i < move->count; i++, from += from_size, to += to_size) {
    if (move->change == SCALED || move->change == ADDED || from_type <= F32 || to_type <= F32) {
      double value = as_double(from, from_type);
      if (move->change == SCALED || move->change == ADDED) value = value * move->factor + move->offset;
      if (move->change == ADDED) value = as_double(to, to_type) + value;
      if (move->negated) value = -value;
      put_double(to, to_type, value);
      continue;
    }
    int large;
    int64_t value = as_integer(from, from_type, &large);
    if (move->change == LOOKED_UP && !look_up(move->lookup, &value, &large)) return OUT_OF_RANGE;
    if (move->negated) {
      if (to_type == TRUTH || from_type == TRUTH)
        value = value == 0;
      else if (large || value == INT64_MIN)
        return OUT_OF_RANGE;
      else
        value = -value;
    }
    if (!put_integer(to, to_type, value, large)) return OUT_OF_RANGE;
  }
  return 0;
}

static inline int move_all(const Move *moves, int64_t n, char *const *bases) {
  for (int64_t i = 0; i < n; i++) {
    const Move *move = &moves[i];
    int status = move_values(move, bases[move->from_base] + move->from, bases[move->to_base] + move->to);
    if (status) return status;
  }
  return 0;
}

static const double JUMP = 4.0, PART = 0.1;

static inline double size_of(double value) { return __builtin_fabs(value); }

/* The row of a source at a point, or its last one: as `CouplingRule` of system/coupling_rule.py. */
static inline int64_t row_at(int64_t point, int64_t points, int64_t last) {
  if (points == 1) return point;
  const int64_t row = point / points;
  return row < last ? row : last;
}

/* Inputs get the middle of the lines of their sources in own step `step`: as `SourceLine` of system/coupling_rule.py. */
static void follow_lines(Member *member, int64_t step) {
  const int64_t begin = step * member->points;
  for (int64_t i = 0; i < member->lines_count; i++) {
    Line *line = &member->lines[i];
    const double value = *line->to;
    const int64_t latest = row_at(begin + line->lead, line->source_points, line->last) * line->source_points;
    if (latest != line->point) {
      const double change = value - line->value, before = line->change / (double)line->distance;
      const int64_t distance = latest - line->point;
      const double larger = size_of(value) > size_of(line->value) ? size_of(value) : size_of(line->value);
      line->jumped = line->point > 0 && size_of(change / (double)distance - before) > JUMP * size_of(before) &&
                     size_of(change) > PART * larger;
      line->change = change;
      line->distance = distance;
      line->point = latest;
    }
    line->value = value;
    if (!line->jumped) {
      const double middle = (double)begin + 0.5 * (double)member->points - (double)line->point;
      *line->to = value + line->change * (middle / (double)line->distance);
    }
  }
}

/* Call a getter or setter; a `size` below 0 is that of a function that takes none. */
static inline int call_values(void *function, void *component, const void *references, int64_t count, void *values,
                              int64_t size) {
  if (size < 0)
    return ((int (*)(void *, const void *, size_t, void *))function)(component, references, (size_t)count, values);
  return ((int (*)(void *, const void *, size_t, void *, size_t))function)(component, references, (size_t)count, values,
                                                                           (size_t)size);
}

static inline int call_all(const Member *member, const Call *calls, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    const Call *call = &calls[i];
    void *values = member->bases[call->base] + call->values;
    int status = call_values(call->function, member->component, call->references, call->count, values, call->size);
    if (status > WARNING || status < 0) {
      member->said->call = (int32_t)i;
      return status;
    }
  }
  return 0;
}

static inline int call_do_step(Member *member, double time, double end) {
  switch (member->kind) {
    case EQUATIONS: return equations_step(member->do_step, end);
    case FMI1:
      return ((int (*)(void *, double, double, char))member->do_step)(member->component, time, member->step_size, 1);
    case FMI2:
      return ((int (*)(void *, double, double, int))member->do_step)(member->component, time, member->step_size, 1);
    default: {
      Said *said = member->said;
      said->event_needed = said->terminate = said->early = 0;
      return ((int (*)(void *, double, double, _Bool, void *, void *, void *, void *))member->do_step)(
          member->component, time, member->step_size, 1, &said->event_needed, &said->terminate, &said->early,
          &said->last_time);
    }
  }
}

/* The time in s at which own step `step` begins: one multiplication, as in Python. */
static inline double time_of(const Member *member, int64_t step) {
  return member->start_time + (double)(step * member->points) * member->base_step_size;
}

/* Set the inputs, take own step `step`, read the outputs. Returns 0, or stage and status of a call; or the stage
 * IN_PYTHON for a step that is Python's: then its inputs are in their row, and the model has not been called. */
static inline int64_t call_step(Member *member, int64_t step) {
  char **bases = member->bases;
  Said *said = member->said;
  for (int i = 0; i < 2; i++) {
    const Output *output = &member->outputs[i];
    bases[OUTPUT + i] = output->rows + ((step + 1) & output->mask) * output->stride;
  }
  const double end = time_of(member, step + 1);
  int status;
  member->stage = SETTING;
  for (int64_t i = 0; i < member->n_tracks; i++)
    *member->tracks[i].to = member->tracks[i].values[step - member->tracks_from];
  if ((status = move_all(member->feeds, member->n_feeds, bases)) != 0)
    return (int64_t)SETTING << STAGE_BITS | status;
  if (member->lines_count) follow_lines(member, step);
  if ((status = move_all(member->loads, member->n_loads, bases)) != 0)
    return (int64_t)SETTING << STAGE_BITS | status;
  if (!(said->quiet_until > end)) return (int64_t)IN_PYTHON << STAGE_BITS;
  if (member->host != NULL) return hosted_step(member, step);
  if ((status = call_all(member, member->setters, member->n_setters)) != 0)
    return (int64_t)SETTING << STAGE_BITS | (status & 0xffffff);
  member->stage = STEPPING;
  status = call_do_step(member, time_of(member, step), end);
  if (status > WARNING || status < 0 ||
      (member->kind == FMI3 && (said->event_needed || said->terminate || said->early)))
    return (int64_t)STEPPING << STAGE_BITS | (status & 0xffffff);
  said->time = end;
  said->step = step + 1;
  member->stage = GETTING;
  if ((status = call_all(member, member->getters, member->n_getters)) != 0 ||
      (status = move_all(member->stores, member->n_stores, bases)) != 0)
    return (int64_t)GETTING << STAGE_BITS | (status & 0xffffff);
  return 0;
}

/* Whether the floats of the row that a step has written are finite, whoever took the step. Integers are compared: a model
 * may have changed the floating-point mode, and let operations with NaN trap. With all bits of the exponent set, one more
 * is carried into the bit of the sign. */
static inline int is_finite(const Member *member, int64_t step) {
  const Output *own = &member->outputs[0];
  const char *row = own->rows + ((step + 1) & own->mask) * own->stride;
  for (int64_t i = 0; i < member->n_finite; i++) {
    const Span *span = &member->finite[i];
    const char *from = row + span->place;
    if (span->type == F64) {
      uint64_t bits, carried = 0;
      for (int64_t j = 0; j < span->count; j++) {
        memcpy(&bits, from + 8 * j, 8);
        carried |= (bits & 0x7ff0000000000000) + 0x0010000000000000;
      }
      if (carried >> 63) return 0;
    } else {
      uint32_t bits, carried = 0;
      for (int64_t j = 0; j < span->count; j++) {
        memcpy(&bits, from + 4 * j, 4);
        carried |= (bits & 0x7f800000) + 0x00800000;
      }
      if (carried >> 31) return 0;
    }
  }
  return 1;
}

PUBLIC int64_t member_is_finite(const Member *member, int64_t step) { return is_finite(member, step); }

/* One step for who counts rows and moves the inputs itself. */
PUBLIC int64_t member_step(Member *member, int64_t step) {
  int64_t outcome = call_step(member, step);
  if (outcome == 0) member->stage = WAITING;
  if (outcome == 0 && !is_finite(member, step)) return (int64_t)GETTING << STAGE_BITS | WRONG_ROW;
  return outcome;
}

/* ---- a node */

/* Release: who sees the stamp of a row sees its values. */
static inline void stamp(Member *member, int64_t row, int64_t value) {
  const Output *own = &member->outputs[0];
  atomic_store_explicit(stamp_of(own->rows, own->stride, own->mask, row), value, memory_order_release);
}

static inline int64_t points_of(const Member *member, int64_t last_point) {
  if (member->step >= member->last_step) return last_point;
  int64_t covered = (member->step + 1) * member->points - 1;
  return covered < last_point ? covered : last_point;
}

/* The last point for which all outputs of a unit are known. */
static inline int64_t covered(const Unit *unit, int64_t last_point) {
  if (unit->n_members == 1) return points_of(unit->members, last_point);
  return unit->tick < last_point ? unit->tick : last_point;
}

static void publish(Node *node) {
  int64_t least = node->last_point;
  for (int64_t i = 0; i < node->n_units; i++) {
    int64_t own = covered(&node->units[i], node->last_point);
    if (own < least) least = own;
  }
  if (least >= atomic_load_explicit(&node->progress->value, memory_order_relaxed))
    raise_counter(&node->place, node->progress, least + 1);
}

/* Before this process waits or leaves: whoever waits for it is awake, and has what it needs. */
static void wake_all(Node *node, int all) {
  publish(node);
  atomic_thread_fence(memory_order_seq_cst);
  wake_if_needed(&node->place, node->progress);
  for (int64_t i = 0; i < node->n_units; i++)
    for (int64_t j = 0; j < node->units[i].n_members; j++)
      wake_if_needed(&node->place, node->units[i].members[j].counter);
  if (node->streams != NULL) streams_write(node->streams, all);
}

/* Claim the points of about one burst: the master may take the grant back, but not what is claimed. */
static inline int64_t claim(Node *node, int64_t point, const Unit *unit) {
  int64_t claimed = atomic_load_explicit(&node->progress->claimed, memory_order_relaxed);
  if (claimed <= point) {
    claimed = point + unit->burst * unit->tick_points;
    atomic_store_explicit(&node->progress->claimed, claimed, memory_order_relaxed);
    atomic_thread_fence(memory_order_seq_cst);
  }
  return claimed < node->last_point ? claimed : node->last_point;
}

/* The point up to which the master and the windows allow steps; whom to wait for if it is not above `point`. */
static int64_t allow(Node *node, int64_t point, Unit *unit) {
  const int64_t claimed = claim(node, point, unit);
  int64_t allowed = value_of(node->ceiling);
  if (allowed > claimed) allowed = claimed;
  if (allowed <= point) { /* by the grant: what is claimed is above it */
    unit->blocked_by = node->ceiling;
    unit->need = point + 1;
    return allowed;
  }
  for (int64_t i = 0; i < node->n_peers; i++) {
    const Peer *peer = &node->peers[i];
    int64_t known = value_of(peer->progress);
    if (known > node->last_point + 1) known = node->last_point + 1;
    int64_t limit = known - 1 + peer->window;
    if (limit < allowed) allowed = limit;
    if (limit <= point) {
      unit->blocked_by = peer->progress;
      unit->need = point + 2 - peer->window;
      return allowed;
    }
  }
  return allowed;
}

/* A sleeper on another core takes up to this time to wake up. Who waits for it for a shorter time falls asleep itself, and
 * both wake each other for ever. */
/* With at most so many ticks in a slice, rows are sent before each tick: nobody waits for a row until the next is done. */
enum { LONG_STEPS = 16 };

enum { SPINS = 60, YIELD_NS = 50000, PATIENCE = 3, REST = 30, QUICK_NS = 200000 };

/* For a node with one unit: look a little longer before it sleeps, unless that was in vain the last times. */
static int soon(Node *node, Counter *counter, int64_t need) {
  if (!node->spins || node->n_units != 1 || counter == node->ceiling) return 0;
  wake_all(node, 0);
  if (node->patience < 0) {
    node->patience++;
    return value_of(counter) >= need;
  }
  int64_t end = 0;
  for (int i = 0;; i++) {
    if (node->streams != NULL) streams_read(node->streams);
    if (value_of(counter) >= need) {
      if (node->patience < PATIENCE) node->patience++;
      return 1;
    }
    if (atomic_load_explicit(&node->attention, memory_order_relaxed)) return 0;
    if (i < SPINS) {
      relax();
      continue;
    }
    sched_yield();
    if (i == SPINS)
      end = now() + YIELD_NS;
    else if (now() > end)
      break;
  }
  node->patience = node->patience > 0 ? node->patience - 1 : -REST;
  return 0;
}

/* After a wait: who gets many rows in a short time sleeps for twice as many the next time. Then others have the processor
 * meanwhile, and the counter does not move from core to core for each row. */
static inline void adapt(Node *node, int is_there, int64_t elapsed_ns) {
  if (!is_there || elapsed_ns > node->slice_ns)
    node->stride = 1;
  else if (elapsed_ns < QUICK_NS && node->stride < node->batch && node->n_units == 1)
    node->stride *= 2;
}

/* Whether to sleep for a value; `points` is what one more of it stands for. */
static inline int blocked(Node *node, Unit *unit, Counter *counter, int64_t need, int64_t points) {
  if (node->streams != NULL && streams_read(node->streams) && value_of(counter) >= need) return 0;
  const int64_t more = counter != node->ceiling ? node->stride / points : 0, last = node->last_point / points + 1;
  if (more > 1 ? value_of(counter) >= need : soon(node, counter, need)) {
    if (more == 1) adapt(node, 1, 0);
    return 0;
  }
  unit->blocked_by = counter;
  unit->need = more > 1 && need < last ? (need + more < last ? need + more : last) : need;
  return 1;
}

enum { READY, NOT_READY, NOT_TRUE };

/* The row that the next step of a member needs. */
static inline int64_t row_of(const Member *member, const Gate *gate) {
  return row_at(member->step * member->points + gate->lead, gate->points, gate->last);
}

/* Whether the rows of all gates are there; then the bases point to them. */
static inline int open_gates(Node *node, Unit *unit, Member *member) {
  for (int64_t i = 0; i < member->n_gates; i++) {
    Gate *gate = &member->gates[i];
    const int64_t row = row_of(member, gate);
    while (gate->known <= row) {
      if ((gate->known = value_of(gate->counter)) > row) break;
      if (blocked(node, unit, gate->counter, row + 1, gate->points)) return NOT_READY;
    }
    member->bases[FIRST_GATE + i] = (char *)(uintptr_t)gate->rows + (row & gate->mask) * gate->stride;
    if (atomic_load_explicit((_Atomic int64_t *)(void *)member->bases[FIRST_GATE + i], memory_order_acquire) != row + 1)
      return NOT_TRUE;
  }
  return READY;
}

/* Whether the rows of all gates are still those that were opened. */
static inline int gates_held(const Member *member) {
  atomic_thread_fence(memory_order_acquire);
  for (int64_t i = 0; i < member->n_gates; i++) {
    const Gate *gate = &member->gates[i];
    const int64_t row = row_of(member, gate);
    if (atomic_load_explicit((_Atomic int64_t *)(void *)member->bases[FIRST_GATE + i], memory_order_relaxed) != row + 1)
      return 0;
  }
  return 1;
}

static inline void commit(Node *node, Member *member) {
  stamp(member, member->step + 1, member->step + 2);
  member->step++;
  member->stage = WAITING;
  raise_counter(&node->place, member->counter, member->step + 1);
}

/* Take own steps of one unit; returns SLICE, or why Python is needed. `*ticks` is the number of complete ticks. */
static int advance(Node *node, Unit *unit, int64_t *ticks) {
  const int64_t first = unit->tick;
  int64_t end = unit->last_tick < first + unit->burst ? unit->last_tick : first + unit->burst;
  int result = SLICE;
  for (; unit->tick < end; unit->tick++, unit->next = 0) {
    const int64_t point = unit->tick * unit->tick_points;
    while (unit->next == 0 && point >= node->allowed && (node->allowed = allow(node, point, unit)) <= point)
      if (blocked(node, unit, unit->blocked_by, unit->need, 1)) goto out;
    if (node->streams != NULL && unit->burst <= LONG_STEPS) streams_write(node->streams, 0);
    for (; unit->next < unit->n_members; unit->next++) {
      Member *member = &unit->members[unit->next];
      if (member->every != 1 &&
          (unit->tick < member->step * member->every + member->wait || member->step >= member->last_step))
        continue;
      if (member->stage != STEPPED) {
        int state = open_gates(node, unit, member);
        if (state == NOT_READY) goto out;
        if (state == NOT_TRUE) {
          result = FORGED;
          goto out;
        }
        stamp(member, member->step + 1, 0);
        atomic_thread_fence(memory_order_release); /* the cleared stamp comes before the values */
        if (member->kind == BY_PYTHON || member->step >= member->python_at) {
          if (move_all(member->feeds, member->n_feeds, member->bases) != 0) {
            member->outcome = (int64_t)SETTING << STAGE_BITS | OUT_OF_RANGE;
            result = STATUS;
          } else {
            result = gates_held(member) ? PYTHON : FORGED;
          }
          member->stage = IN_PYTHON;
          goto out;
        }
        member->outcome = call_step(member, member->step);
        if (mode_changed()) {
          fesetenv(FE_DFL_ENV);
          node->restored++;
        }
        if (!gates_held(member)) {
          result = FORGED;
          goto out;
        }
        if (member->outcome != 0) {
          result = STATUS;
          goto out;
        }
      }
      if (!is_finite(member, member->step)) {
        result = NOT_FINITE;
        goto out;
      }
      commit(node, member);
    }
    if (node->n_units == 1) {
      int64_t reached = unit->n_members == 1 ? points_of(unit->members, node->last_point) : unit->tick + 1;
      if (reached > node->last_point) reached = node->last_point;
      if (reached >= atomic_load_explicit(&node->progress->value, memory_order_relaxed))
        raise_counter(&node->place, node->progress, reached + 1);
    }
    if (atomic_load_explicit(&node->attention, memory_order_relaxed)) {
      unit->tick++;
      unit->next = 0;
      break;
    }
  }
out:
  *ticks = unit->tick - first;
  node->unit = unit - node->units;
  node->member = unit->next;
  return result;
}

/* For the host of an FMU under Wine: there, the member is like any other. */
int64_t take_step(Member *member, int64_t step) { return call_step(member, step); }

int64_t take_burst(Node *node, int64_t *ticks) { return advance(node, node->units, ticks); }

/* What a unit sleeps for. Of a grant and a row that it lacks, the row comes later, because its source steps with the grant,
 * too: who slept for the grant would wake twice for each point of a run that the wall clock paces. */
static inline Wish wish_of(const Node *node, const Unit *unit) {
  const Member *member = &unit->members[0];
  if (unit->blocked_by == node->ceiling && member->every == 1 && member->stage == WAITING)
    for (int64_t i = 0; i < member->n_gates; i++) {
      const int64_t row = row_of(member, &member->gates[i]);
      if (value_of(member->gates[i].counter) <= row) return (Wish){member->gates[i].counter, row + 1};
    }
  return (Wish){unit->blocked_by, unit->need};
}

/* Sleep until a unit may step, Python has something to do, or the time is over. */
static int64_t await(Node *node, int64_t limit_ns) {
  uint32_t seen = bell_seen(&node->place);
  if (atomic_load_explicit(&node->attention, memory_order_seq_cst)) return 0;
  Wish wishes[65]; /* of more units, the others look again when one of these may step, or the time is over */
  int64_t n = 0;
  int by_grant = 0;
  for (int64_t i = 0; i < node->n_units; i++) {
    const Unit *unit = &node->units[i];
    if (unit->stopped || unit->tick >= unit->last_tick) continue;
    by_grant |= unit->blocked_by == node->ceiling;
    if (n < 64)
      wishes[n++] = wish_of(node, unit);
    else if (limit_ns > 1000000)
      limit_ns = 1000000;
  }
  wake_all(node, by_grant); /* the master of another host grants more when it knows that this node is there */
  if (node->stride > 1 && !by_grant && limit_ns > node->slice_ns) limit_ns = node->slice_ns;
  int64_t start = now();
  wishes[n] = (Wish){node->finish != NULL && value_of(node->finish) == 0 ? node->finish : NULL, 1};
  int64_t is_granted = sleep_on(&node->place, node->streams, seen, wishes, n + 1, limit_ns, &node->late), elapsed = now() - start;
  node->waited_ns += elapsed;
  if (n == 1 && wishes[0].counter != node->ceiling) adapt(node, is_granted != 0, elapsed);
  return is_granted || bell_seen(&node->place) != seen;
}

/* Step as far as it goes, for about one slice of time. Call it again and again. */
PUBLIC int64_t node_run(Node *node) {
  int64_t start = now(), begin = start;
  const int64_t quiet_until = start + node->quiet_ns;
  int any = 0;
  for (;;) {
    int stepped = 0, left = 0, by_grant = 1;
    for (int64_t i = 0; i < node->n_units; i++) {
      Unit *unit = &node->units[i];
      if (unit->stopped || unit->tick >= unit->last_tick) continue;
      int64_t ticks = 0;
      int result = unit->n_members == 1 && unit->members->host != NULL ? hosted_advance(node, unit, &ticks) : NOT_HOSTED;
      if (result == NOT_HOSTED) result = advance(node, unit, &ticks);
      int64_t end = now(), elapsed = end - begin;
      begin = end;
      if (ticks > 0) {
        stepped = any = 1;
        unit->spent_ns += elapsed;
        if (ticks == unit->burst && elapsed < node->slice_ns)
          unit->burst = unit->burst < 4096 ? 2 * unit->burst : 4096;
        else if (elapsed > 2 * node->slice_ns && unit->burst > 1)
          unit->burst = (ticks < unit->burst ? ticks : unit->burst) / 2 + (ticks < 2);
      }
      if (result != SLICE) {
        wake_all(node, 0);
        return result;
      }
      left += unit->tick < unit->last_tick;
      by_grant &= unit->blocked_by == node->ceiling;
      /* Without a step it has not begun: else many units would be looked through in vain, each time from the first. */
      if (atomic_load_explicit(&node->attention, memory_order_relaxed) || (any && begin - start > 2 * node->slice_ns)) {
        wake_all(node, 0);
        return ATTENTION;
      }
    }
    if (left == 0) {
      if (!any) await(node, node->wait_ns); /* for what Python has to do */
      wake_all(node, 1);
      return DONE;
    }
    if (!stepped) {
      /* After a step that somebody looks at only a little, as its rows may be streamed, or sent; and not for a grant, which
       * may come with the next tick of the wall clock. */
      const int is_first = !any || (node->quiet_ns > 0 && begin < quiet_until);
      int64_t limit_ns = is_first ? node->wait_ns : node->eager || by_grant ? 0 : node->slice_ns - (begin - start);
      if (limit_ns <= 0 || !await(node, limit_ns)) {
        wake_all(node, by_grant);
        return BLOCKED;
      }
      begin = now();
      if (is_first) start = begin; /* the slice begins with the first step */
    }
    if (any && begin - start > node->slice_ns) {
      wake_all(node, 0);
      return SLICE;
    }
  }
}

/* From any thread: let the node leave its burst. */
PUBLIC void node_attend(Node *node) {
  atomic_store_explicit(&node->attention, 1, memory_order_seq_cst);
  ring_bell(&node->place.bells[node->place.own]);
}

/* Seq_cst: Python looks for the reasons after it, and who has one stores it before `attention`. */
PUBLIC void node_attended(Node *node) { atomic_store_explicit(&node->attention, 0, memory_order_seq_cst); }

/* ---- copies: many systems in this process, each with tables of its own. Nobody else reads their memory, so nothing
 * waits: a unit that lacks a row is a fault of its plan. With several threads, each works on a part of the copies; the
 * first one writes the work, and touches it again when all others are done. */

/* Step a copy to its goal. All instances are members of one unit, in the order of the plan: so a copy ends at an event as
 * if each of them had been called in its turn. Returns a BurstEnd. */
static int64_t step_copy(Copy *copy) {
  if (copy->point >= copy->goal) return DONE; /* it may have ended, and have no node any more */
  Unit *unit = copy->node->units;
  unit->last_tick = unit->burst = copy->goal / unit->tick_points;
  while (unit->tick < unit->last_tick) {
    int64_t ticks;
    const int result = advance(copy->node, unit, &ticks);
    copy->point = (unit->tick + 1) * unit->tick_points - 1; /* between two ticks, the outputs hold */
    if (result != SLICE) return result;
    if (ticks == 0) return BLOCKED;
    if (atomic_load_explicit(&copy->node->attention, memory_order_relaxed)) return ATTENTION;
  }
  copy->point = copy->goal;
  return DONE;
}

/* Functions of CPython, all of its stable ABI; library.py gives their addresses in this order. */
typedef struct {
  void *(*save_thread)(void);
  void (*restore_thread)(void *);
  void *(*make_integer)(long long);
  void *(*call)(void *callable, ...);
  void (*hold)(void *);
  void (*release)(void *);
} Interpreter;

/* Call Python for the step of a member. Whether it has raised nothing. */
static inline int called_python(const Interpreter *python, const Member *member) {
  void *const callable = member->by_python, *const step = python->make_integer(member->step);
  if (step == NULL) return 0;
  python->hold(callable); /* the call may give the member another one */
  void *const result = python->call(callable, step, NULL);
  python->release(callable);
  python->release(step);
  if (result == NULL) return 0;
  python->release(result);
  return 1;
}

/* As `step_copy` if there is a copy, and otherwise as `node_run`; and steps that are Python's are taken, too, so that each
 * of them costs one call. After `most_ns`, a node leaves at the end of the tick. With RAISED, an exception is set, and the
 * step is that of the node's `unit` and `member`. */
PUBLIC int64_t run_with_python(const Interpreter *python, Node *node, Copy *copy, int64_t most_ns) {
  const int64_t start = now();
  for (;;) {
    void *const thread = python->save_thread();
    const int64_t result = copy != NULL ? step_copy(copy) : node_run(node);
    python->restore_thread(thread);
    if (result != PYTHON) return result;
    Unit *unit = &node->units[node->unit];
    Member *member = &unit->members[node->member];
    const int64_t begin = now();
    if (!called_python(python, member)) return RAISED;
    if (mode_changed()) fesetenv(FE_DFL_ENV);
    member->stage = STEPPED;
    const int64_t end = now();
    unit->spent_ns += end - begin;
    if (copy == NULL && end - start > most_ns) node_attend(node);
  }
}

/* Whether a getter, a setter or a function that sets a state could be called. */
static inline int call_copy(const CopyCall *own, char *values) {
  int status = own->count < 0 ? ((int (*)(void *, const void *))own->function)(own->component, own->references)
                              : call_values(own->function, own->component, own->references, own->count, values, own->size);
  return status <= WARNING && status >= 0;
}

/* Copy an output from the row at the point of a copy. */
static inline void read_copy(const Copy *copy, const CopyOutput *output, int64_t size, char *to) {
  if (output->first == NULL) return;
  const int64_t row = output->points == 1 ? copy->point : copy->point / output->points;
  const char *from = output->first + (row & output->mask) * output->stride;
  if (size == 8)
    memcpy(to, from, 8);
  else
    memcpy(to, from, (size_t)size);
}

/* Bring a copy back to its first point: each of its FMUs by its state, and memory that was kept. Whether there is that. */
static inline int restore_copy(const Work *work, int64_t number) {
  int64_t *const *places = (int64_t *const *)work->places + number * (1 + work->pieces_each);
  if (places[0] == NULL) return 0;
  const CopyCall *calls = &work->calls[number * work->calls_each];
  for (int64_t i = 0; i < work->calls_each; i++)
    if (!call_copy(&calls[i], NULL)) return 0;
  for (int64_t i = 0; i < work->pieces_each; i++) {
    int64_t *restrict to = places[1 + i];
    const int64_t *restrict from = places[0] + work->pieces[i].kept;
    for (int64_t left = work->pieces[i].size; left > 0; left--) *to++ = *from++;
  }
  work->copies[number].point = work->copies[number].goal = 0;
  return 1;
}

/* The copies of one thread. */
static int64_t work_on(const Work *work, int64_t first, int64_t end) {
  int64_t left = 0;
  for (int64_t i = first; i < end; i++) {
    int is_done = 1;
    if (work->wanted != NULL && !work->wanted[i]) continue;
    switch (work->kind) {
      case STEP: is_done = (work->copies[i].end = step_copy(&work->copies[i])) == DONE; break;
      case CALL: is_done = call_copy(&work->calls[i], work->values + i * work->stride); break;
      case READ: read_copy(&work->copies[i], &work->reads[i], work->size, work->values + i * work->stride); break;
      default: is_done = restore_copy(work, i);
    }
    left += !is_done;
    if (work->wanted != NULL) work->wanted[i] = !is_done;
  }
  return left;
}

/* Awake for a while, as another thread is about to raise the counter, and then asleep. */
static void await_work(const Place *place, Counter *counter, int64_t need) {
  const int64_t end = now() + YIELD_NS;
  for (int i = 0; value_of(counter) < need; i++) {
    if (i < SPINS) {
      relax();
    } else if (now() < end) {
      sched_yield();
    } else {
      const uint32_t seen = bell_seen(place);
      const Wish wish = {counter, need};
      sleep_on(place, NULL, seen, &wish, 1, 1000000000, NULL);
    }
  }
}

/* On the first thread: all threads work, and this one waits for the others. Returns how many copies need Python. */
PUBLIC int64_t copies_work(Worker *workers, int64_t n) {
  const int64_t number = n > 1 ? value_of(workers->asked) + 1 : 0;
  int64_t left = 0;
  if (n > 1) counter_raise(&workers->place, workers->asked, number);
  if (workers->work->kind != HAND_OVER) left = work_on(workers->work, workers->first, workers->end);
  for (int64_t i = 1; i < n; i++) {
    await_work(&workers->place, workers[i].done, number);
    left += workers[i].left;
  }
  return left;
}

/* On each other thread: work, until it is Python's turn there, which then raises `done`. */
PUBLIC void copies_serve(Worker *own) {
  for (int64_t number = value_of(own->done);; number++) {
    counter_raise(&own->place, own->done, number);
    await_work(&own->place, own->asked, number + 1);
    const int is_handed_over = own->work->kind == HAND_OVER;
    if (is_handed_over && own->work->size == own->place.own) return;
    own->left = is_handed_over ? 0 : work_on(own->work, own->first, own->end);
  }
}
