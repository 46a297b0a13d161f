/* What processes share: counters, the bells of sleepers, and who wakes whom. `burst.c` explains the protocol; it and
 * `streams.c` include this. */
#ifndef FMU_MESH_COUNTERS_H
#define FMU_MESH_COUNTERS_H

#include <stdatomic.h>
#include <stdint.h>
#ifndef _WIN32
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <linux/futex.h>
#include <sched.h>
#include <stdio.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
#endif

#include "burst.h"

#define PUBLIC __attribute__((visibility("default")))
#define NEVER INT64_MAX

struct Counter {
  _Atomic int64_t value;   /* rows of a ring, points that are known of a node, or points that are granted */
  _Atomic int64_t wake_at; /* the lowest need of a sleeper */
  _Atomic int64_t claimed; /* of a node: it may step below this point without another look at the grant */
  int64_t unused[5];
  _Atomic int64_t needs[]; /* one for each process: the value that it sleeps for; 0: it does not sleep */
};

struct Bell {
  _Atomic uint32_t rung;
  _Atomic uint32_t polls;         /* its process waits for file descriptors, too: then it is rung by a pipe */
  _Atomic int32_t process, pipe;  /* the pipe: who has it, and the descriptor there */
  _Atomic uint32_t owed; /* a host under Wine has rung it, and cannot wake: its node does that */
  uint32_t unused[11];
};

/* ---- waiting */

#ifdef _WIN32 /* the host of an FMU under Wine: it has no futex, and windows.h has names of ours */
int SwitchToThread(void);
int QueryPerformanceCounter(int64_t *);
void nudge(void); /* let the node of this host look */

static inline int64_t now(void) {
  int64_t ticks;
  QueryPerformanceCounter(&ticks);
  return 100 * ticks; /* Wine's have 100 ns */
}

static inline int sched_yield(void) { return SwitchToThread(); }

static inline void wake_bell(Bell *bell) {
  atomic_store_explicit(&bell->owed, 1, memory_order_release); /* after `rung` */
  nudge();
}
#else
static inline int64_t now(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

/* Of another process, the end of the pipe to write to is opened as its memory was: through /proc. */
static inline void ring_pipe(const Bell *bell) {
  /* relaxed: both were stored before `polls`, which has been read */
  const int32_t process = atomic_load_explicit(&bell->process, memory_order_relaxed);
  const int32_t pipe = atomic_load_explicit(&bell->pipe, memory_order_relaxed);
  int fd = pipe;
  if (process != getpid()) {
    char path[64];
    snprintf(path, sizeof path, "/proc/%d/fd/%d", process, pipe);
    fd = open(path, O_WRONLY | O_NONBLOCK | O_CLOEXEC);
    if (fd < 0) return; /* it was killed, or it is about to end */
  }
  ssize_t written = write(fd, "", 1); /* a full pipe wakes, too */
  (void)written;
  if (fd != pipe) close(fd);
}

static inline void wake_bell(Bell *bell) {
  if (atomic_load_explicit(&bell->polls, memory_order_seq_cst))
    ring_pipe(bell);
  else
    syscall(SYS_futex, &bell->rung, FUTEX_WAKE, INT_MAX, NULL, NULL, 0);
}
#endif

static inline void relax(void) {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  __asm__ volatile("yield");
#endif
}

/* All seq_cst: `needs` was stored before, and a writer that finds `wake_at` lowered has to find it. */
static inline void lower(_Atomic int64_t *place, int64_t value) {
  int64_t seen = atomic_load_explicit(place, memory_order_seq_cst);
  while (value < seen &&
         !atomic_compare_exchange_weak_explicit(place, &seen, value, memory_order_seq_cst, memory_order_seq_cst))
    continue;
}

static inline void ring(Bell *bell) {
  /* seq_cst: of this and `poll_streams`, which stores `polls` and then looks at the bell, one sees the other */
  atomic_fetch_add_explicit(&bell->rung, 1, memory_order_seq_cst);
  wake_bell(bell);
}

/* Wake everybody whose need is met; again if the value has grown meanwhile. All seq_cst, as in `lower`: the scan comes
 * after NEVER, and finds whoever has lowered `wake_at` before that. */
static inline void wake(const Place *place, Counter *counter) {
  int64_t lowest;
  do {
    atomic_store_explicit(&counter->wake_at, NEVER, memory_order_seq_cst);
    int64_t value = atomic_load_explicit(&counter->value, memory_order_seq_cst);
    lowest = NEVER;
    for (int64_t process = 0; process < place->processes; process++) {
      int64_t need = atomic_load_explicit(&counter->needs[process], memory_order_seq_cst);
      if (need == 0) continue;
      if (need > value) {
        if (need < lowest) lowest = need;
      } else if (atomic_compare_exchange_strong_explicit(&counter->needs[process], &need, 0, memory_order_seq_cst,
                                                         memory_order_seq_cst)) {
        ring(&place->bells[process]);
      }
    }
    if (lowest != NEVER) lower(&counter->wake_at, lowest);
  } while (lowest != NEVER && atomic_load_explicit(&counter->value, memory_order_seq_cst) >= lowest);
}

/* Relaxed: who must not miss a sleeper has a fence before it. */
static inline void wake_if_needed(const Place *place, Counter *counter) {
  if (atomic_load_explicit(&counter->wake_at, memory_order_relaxed) <=
      atomic_load_explicit(&counter->value, memory_order_relaxed))
    wake(place, counter);
}

/* Release, and acquire in `value_of`: who sees the value sees all that was written before it. */
static inline void raise_counter(const Place *place, Counter *counter, int64_t value) {
  atomic_store_explicit(&counter->value, value, memory_order_release);
  wake_if_needed(place, counter);
}

static inline int64_t value_of(const Counter *counter) {
  return atomic_load_explicit(&counter->value, memory_order_acquire);
}

/* The stamp of a row: the first eight bytes of its slot. */
static inline _Atomic int64_t *stamp_of(const char *rows, int64_t stride, int64_t mask, int64_t row) {
  return (_Atomic int64_t *)(uintptr_t)(rows + (row & mask) * stride);
}

/* ---- an FMU under Wine: see hosted.c */

enum { NOT_HOSTED = -1 };

/* As `call_step`, when the row of inputs is there. */
int64_t hosted_step(Member *member, int64_t step);

/* As `advance`, for a unit of one member; NOT_HOSTED: the host does not share the memory that is needed. */
int hosted_advance(Node *node, Unit *unit, int64_t *ticks);

/* What the host does then. */
int64_t take_step(Member *member, int64_t step);
int64_t take_burst(Node *node, int64_t *ticks);

/* ---- streams: see streams.c */

/* Sleep until a wish is granted, something came by a stream, the bell is rung, or the time is over; `seen` is the bell
 * when the caller last looked for other reasons to stay awake. Returns whether a wish is granted. */
int64_t sleep_on(const Place *place, Streams *streams, uint32_t seen, const Wish *wishes, int64_t n, int64_t limit_ns,
                 int64_t *late);

/* Take what has come; whether there was anything. */
int streams_read(Streams *streams);

/* Send what is new; with `all`, also what may wait for a while. */
PUBLIC void streams_write(Streams *streams, int64_t all);

#endif
