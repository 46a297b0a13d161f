/* Row streams: what processes of one host find in shared memory, processes of two hosts send each other.
 *
 * A stream is one socket between two processes. Each of them has its own memory, with the same rings and counters; the
 * stream carries new rows of rings, and counters that have grown (the progress of a process, the grant of the master),
 * and its reader writes them into its memory. So the burst, the master and the recorder wait for counters as they do
 * on one host, and only who wakes them is different.
 *
 * Threads. Of one process, all streams are read by one thread: the main thread of a node, between and within its waits,
 * or a thread of the master's process, which does nothing else (`streams_serve`). The same thread writes, and so does
 * the main thread of the master, so that a grant wakes no other thread of its process on its way. Where the kernel takes no more bytes, because a large row does not fit or the network is slow, a thread of its own sends the
 * rest, so that a long step holds nothing back, and ends when nothing is left. Who writes has `sending`: a flag that is
 * taken with one instruction, and nobody waits for it: who finds it taken knows that the other one sends everything.
 * Python changes a stream only while it has the flag, on the thread that reads.
 *
 * What may go wrong, and what then happens:
 *   - The socket ends, or its link is cut: `state` is CUT, nothing more is read or written, and the rows stay in the
 *     ring of their writer, because it may not be further ahead than the windows. A new connection goes on with the
 *     row that the reader lacks; a row that comes twice has to be the same in every bit (TWICE).
 *   - Somebody sends other bytes: each length and number is compared before it is used, a row that is missing is a GAP,
 *     and anything else is REFUSED. A row that overwrites one that is still needed clears its stamp, and its reader
 *     sees that (burst.c, "Rows").
 *   - A row is overwritten before it was sent: its stamp says so. The windows allow that only where its reader has it:
 *     the connection before this one has healed after the reader had said how many rows it has. So the next frame
 *     begins at the oldest row of the ring, and a reader that lacks one finds a GAP. If no row can have replaced it,
 *     `state` is LATE.
 *   - The process ends while the other thread sends: who closes the stream shuts the socket down, and takes the flag.
 *
 * Memory orders (burst.c has the rules). `state` is stored with release: why is stored before it. Who takes `sending` or
 * sees that somebody has asked (acquire) sees what the others had before they wrote it (release). `sent` and `flushed_ns`
 * are relaxed: who has the flag writes them, and others only decide when to look.
 *
 * Waiting. `poll` does not wait for a futex. So a process with streams, before it polls, says so in its bell, and looks
 * once more at what it waits for; who rings such a bell writes into a pipe (`counters.h`). Rings alone cost no system
 * call more. Considered and given up: an eventfd, which no other process can open, and io_uring, which containers
 * forbid. ADR 74 has the decision.
 */
#define _GNU_SOURCE
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <string.h>
#include <sys/socket.h>

#include "counters.h"

typedef struct { /* as `fmu_mesh.wire.messages.HEADER`; in front of each frame */
  uint8_t kind, spare[3];
  uint32_t link, count, zero;
  int64_t point;
} Header;

enum { FRAME = 1, GRANT = 3, PROGRESS = 4, FINISH = 5, LAST = 8, ALIVE = 10 }; /* of frames, as `fmu_mesh.wire.messages` has them */

/* ---- sending */

static void put(Stream *stream, const void *bytes, int64_t size) {
  memcpy(stream->to_send + stream->send_to, bytes, (size_t)size);
  stream->send_to += size;
}

static void put_header(Stream *stream, int kind, int64_t link, int64_t count, int64_t point) {
  const Header header = {.kind = (uint8_t)kind, .link = (uint32_t)link, .count = (uint32_t)count, .point = point};
  put(stream, &header, sizeof header);
}

static inline int64_t rows_sent(const Outgoing *out) { return atomic_load_explicit(&out->sent, memory_order_relaxed); }

static inline int is_open(const Stream *stream) {
  return atomic_load_explicit(&stream->state, memory_order_acquire) == OPEN;
}

static int64_t room(const Stream *stream) { return stream->send_size - stream->send_to - (int64_t)sizeof(Header); }

/* Put rows of a ring into the buffer, as many as fit. Returns whether some are left. */
static int put_rows(Stream *stream, Outgoing *out, int64_t ready) {
  int64_t next = rows_sent(out);
  while (next < ready) {
    int64_t count = room(stream) / out->row_bytes;
    if (count <= 0) return 1;
    if (count > ready - next) count = ready - next;
    const int64_t begin = stream->send_to, end = next + count;
    put_header(stream, FRAME, out->link, count, next);
    for (; next < end; next++) {
      _Atomic int64_t *stamp = stamp_of(out->rows, out->stride, out->mask, next);
      const char *row = (const char *)stamp;
      for (int64_t i = 0; i < out->n_pieces; i++) put(stream, row + out->pieces[i].place, out->pieces[i].size);
      atomic_thread_fence(memory_order_acquire);
      if (atomic_load_explicit(stamp, memory_order_relaxed) == next + 1) continue;
      const int64_t oldest = value_of(out->counter) - out->mask - 1; /* may be overwritten just now */
      if (oldest < next) { /* it is in the ring, and no writer leaves it like this */
        stream->about = out->link;
        atomic_store_explicit(&stream->state, LATE, memory_order_release);
        return 0;
      }
      stream->send_to = begin;
      next = oldest > next ? oldest : next + 1;
      break;
    }
    atomic_store_explicit(&out->sent, next, memory_order_relaxed);
  }
  return 0;
}

/* Put what is new into the buffer: with `all`, also what may wait. Returns whether something did not fit. */
static int fill(Stream *stream, int all) {
  for (int64_t i = 0; i < stream->n_told; i++) { /* before any rows, which may be many: others wait for these numbers */
    Told *told = &stream->told[i];
    const int64_t value = value_of(told->counter);
    const int64_t sent = atomic_load_explicit(&told->sent, memory_order_relaxed);
    if (value <= sent || (told->stride > 0 ? value < sent + told->stride : !all)) continue;
    if (room(stream) < 0) return 1;
    put_header(stream, told->kind, told->number, 0, value);
    atomic_store_explicit(&told->sent, value, memory_order_relaxed);
  }
  for (int64_t i = 0; i < stream->n_outgoing; i++) {
    Outgoing *out = &stream->outgoing[i];
    /* Acquire, and before the counter: if no more rows come, the counter has all of them. */
    const int64_t last = atomic_load_explicit(&out->last, memory_order_acquire);
    const int64_t ready = value_of(out->counter), left = ready - rows_sent(out);
    if (left > 0 && (!out->lazy || all || left > out->mask / 4) && put_rows(stream, out, ready)) return 1;
    if (rows_sent(out) == ready && last == UNSAID) {
      if (room(stream) < 0) return 1;
      put_header(stream, LAST, out->link, 0, ready);
      atomic_store_explicit(&out->last, SAID, memory_order_relaxed);
    }
  }
  return 0;
}

/* Give the kernel what it takes of all that is new, while `sending` is held. Returns whether bytes or rows are left. */
static int send_new(Stream *stream, int all) {
  for (;;) {
    const int left = fill(stream, all);
    while (is_open(stream) && stream->send_from < stream->send_to) {
      ssize_t sent = send((int)stream->fd, stream->to_send + stream->send_from,
                          (size_t)(stream->send_to - stream->send_from), MSG_DONTWAIT | MSG_NOSIGNAL);
      if (sent >= 0)
        stream->send_from += sent;
      else if (errno == EAGAIN || errno == EWOULDBLOCK)
        return 1;
      else if (errno != EINTR)
        atomic_store_explicit(&stream->state, CUT, memory_order_release);
    }
    if (!is_open(stream)) return 0;
    stream->send_from = stream->send_to = 0;
    if (!left) return 0;
  }
}

/* Whether something is not sent yet that nobody has to wait for. */
static int has_new(const Stream *stream) {
  for (int64_t i = 0; i < stream->n_outgoing; i++)
    if (value_of(stream->outgoing[i].counter) > rows_sent(&stream->outgoing[i]) ||
        atomic_load_explicit(&stream->outgoing[i].last, memory_order_relaxed) == UNSAID)
      return 1;
  for (int64_t i = 0; i < stream->n_told; i++)
    if (stream->told[i].stride <= 1 &&
        value_of(stream->told[i].counter) > atomic_load_explicit(&stream->told[i].sent, memory_order_relaxed))
      return 1;
  return 0;
}

/* Replace what `sending` was; whether it was that. Otherwise, `was` is what it is. */
static inline int set_flag(Stream *stream, int64_t *was, int64_t value) {
  return atomic_compare_exchange_strong_explicit(&stream->sending, was, value, memory_order_acq_rel,
                                                 memory_order_relaxed);
}

static int take_flag(Stream *stream) {
  int64_t nobody = 0;
  return set_flag(stream, &nobody, 1);
}

/* Take the flag, or ask the thread that has it to send once more what is new. Who finds that somebody has asked writes the
 * flag again: only then the other thread sees what is new here, too. */
static int take_flag_or_ask(Stream *stream) {
  for (;;) {
    int64_t seen = 0;
    if (set_flag(stream, &seen, 1)) return 1;
    if (set_flag(stream, &seen, 2)) return 0;
  }
}

static void *send_rest(void *argument) {
  Stream *stream = argument;
  int64_t own;
  do {
    atomic_exchange_explicit(&stream->sending, 1, memory_order_acquire); /* sees what was new when somebody asked */
    while (send_new(stream, 1)) {
      struct pollfd one = {(int)stream->fd, POLLOUT, 0};
      poll(&one, 1, 100);
    }
    own = 1; /* without the flag, the stream may be freed: nothing may look at it any more */
  } while (!set_flag(stream, &own, 0));
  return NULL;
}

/* Let a thread send the rest; it gives the flag back. Without a thread, the next call goes on. */
static void send_on(Stream *stream) {
  pthread_t thread;
  pthread_attr_t attributes;
  sigset_t all, before;
  pthread_attr_init(&attributes);
  pthread_attr_setdetachstate(&attributes, PTHREAD_CREATE_DETACHED);
  pthread_attr_setstacksize(&attributes, 1 << 17);
  sigfillset(&all); /* signals are for the main thread */
  pthread_sigmask(SIG_SETMASK, &all, &before);
  if (pthread_create(&thread, &attributes, send_rest, stream) != 0)
    atomic_store_explicit(&stream->sending, 0, memory_order_release);
  pthread_sigmask(SIG_SETMASK, &before, NULL);
  pthread_attr_destroy(&attributes);
}

/* Send what is new, give the flag back, and once more if somebody has asked meanwhile. */
static void send_and_release(Stream *stream, int all) {
  for (int64_t own = 1;; own = all = 1) {
    atomic_exchange_explicit(&stream->sending, 1, memory_order_acquire);
    if (send_new(stream, all)) return send_on(stream);
    if (set_flag(stream, &own, 0)) return;
  }
}

static void write_stream(const Streams *streams, Stream *stream, int all) {
  if (!is_open(stream)) return;
  if (!all && now() - atomic_load_explicit(&stream->flushed_ns, memory_order_relaxed) > streams->lazy_ns) all = 1;
  if (all) atomic_store_explicit(&stream->flushed_ns, now(), memory_order_relaxed); /* also if the other thread sends it */
  if (take_flag_or_ask(stream)) send_and_release(stream, all);
}

void streams_write(Streams *streams, int64_t all) {
  for (int64_t i = 0; i < streams->n_streams; i++) write_stream(streams, &streams->streams[i], all != 0);
}

/* ---- receiving */

static void refuse(Stream *stream, int state, int64_t about, int64_t row) {
  stream->about = about;
  stream->about_row = row;
  atomic_store_explicit(&stream->state, state, memory_order_release);
}

static int is_same(const Incoming *in, const char *row, const char *bytes) {
  for (int64_t i = 0; i < in->n_pieces; bytes += in->pieces[i++].size)
    if (memcmp(row + in->pieces[i].place, bytes, (size_t)in->pieces[i].size) != 0) return 0;
  return 1;
}

/* Write one row into its ring. Returns whether it can be a row of this link. */
static int put_row(const Incoming *in, int64_t row, const char *bytes) {
  _Atomic int64_t *stamp = stamp_of(in->rows, in->stride, in->mask, row);
  char *place = (char *)(uintptr_t)stamp;
  atomic_store_explicit(stamp, 0, memory_order_relaxed);
  atomic_thread_fence(memory_order_release); /* the cleared stamp comes before the values */
  for (int64_t i = 0; i < in->n_pieces; bytes += in->pieces[i++].size) {
    const Piece *piece = &in->pieces[i];
    if (piece->truths)
      for (int64_t j = 0; j < piece->size; j++)
        if ((uint8_t)bytes[j] > 1) return 0;
    memcpy(place + piece->place, bytes, (size_t)piece->size);
  }
  atomic_store_explicit(stamp, row + 1, memory_order_release);
  return 1;
}

/* Take the rows of a frame that have come completely. */
static void take_rows(const Place *place, Stream *stream) {
  Incoming *in = &stream->incoming[stream->frame];
  const int64_t known = value_of(in->counter);
  for (; stream->rows_left > 0 && stream->filled - stream->used >= in->row_bytes; stream->rows_left--, stream->row++) {
    const char *bytes = stream->received + stream->used;
    stream->used += in->row_bytes;
    if (stream->row < known) { /* it came before the connection was cut; an old one may be overwritten */
      const char *row = (const char *)stamp_of(in->rows, in->stride, in->mask, stream->row);
      if (stream->row > known - 1 - in->mask && !is_same(in, row, bytes))
        return refuse(stream, TWICE, in->link, stream->row);
    } else if (!put_row(in, stream->row, bytes)) {
      return refuse(stream, REFUSED, in->link, stream->row);
    }
  }
  if (stream->row > known) {
    atomic_store_explicit(&in->counter->value, stream->row, memory_order_release);
    atomic_thread_fence(memory_order_seq_cst);
    wake_if_needed(place, in->counter);
  }
}

static void take_number(const Place *place, Stream *stream, const Header *header) {
  for (int64_t i = 0; i < stream->n_heard; i++) {
    const Heard *heard = &stream->heard[i];
    if (heard->kind != header->kind || heard->number != header->link) continue;
    if (header->point < 0 || header->point > heard->most) break;
    if (header->point > value_of(heard->counter)) {
      atomic_store_explicit(&heard->counter->value, header->point, memory_order_release);
      atomic_thread_fence(memory_order_seq_cst);
      wake_if_needed(place, heard->counter);
    }
    return;
  }
  refuse(stream, REFUSED, header->kind, header->point);
}

/* Begin a frame: its rows go on where the last one has ended, or come again. */
static void take_frame(Stream *stream, const Header *header) {
  for (int64_t i = 0; i < stream->n_incoming; i++) {
    Incoming *in = &stream->incoming[i];
    if (in->link != header->link) continue;
    if (header->kind == LAST) {
      in->ended = 1;
      stream->has_ended = 1;
      return;
    }
    if (header->count == 0 || header->point < 0 || header->point > in->most - (int64_t)header->count)
      return refuse(stream, REFUSED, in->link, header->point);
    if (header->point > value_of(in->counter)) return refuse(stream, GAP, in->link, header->point);
    stream->frame = i;
    stream->row = header->point;
    stream->rows_left = header->count;
    return;
  }
  refuse(stream, REFUSED, header->link, header->point);
}

static void take(const Place *place, Stream *stream) {
  while (is_open(stream)) {
    if (stream->rows_left > 0) {
      take_rows(place, stream);
      if (stream->rows_left > 0) return;
    }
    Header header;
    if (stream->filled - stream->used < (int64_t)sizeof header) return;
    memcpy(&header, stream->received + stream->used, sizeof header);
    stream->used += (int64_t)sizeof header;
    switch (header.kind) {
      case FRAME:
      case LAST: take_frame(stream, &header); break;
      case GRANT:
      case FINISH:
      case PROGRESS: take_number(place, stream, &header); break;
      case ALIVE: break;
      default: refuse(stream, REFUSED, header.kind, header.point);
    }
  }
}

static int read_stream(const Place *place, Stream *stream) {
  int any = 0;
  while (is_open(stream)) {
    if (stream->used == stream->filled) {
      stream->used = stream->filled = 0;
    } else if (stream->used > stream->receive_size / 2 || stream->filled == stream->receive_size) {
      memmove(stream->received, stream->received + stream->used, (size_t)(stream->filled - stream->used));
      stream->filled -= stream->used;
      stream->used = 0;
    }
    const int64_t free_bytes = stream->receive_size - stream->filled;
    ssize_t got = recv((int)stream->fd, stream->received + stream->filled, (size_t)free_bytes, MSG_DONTWAIT);
    if (got > 0) {
      any = 1;
      stream->filled += got;
      take(place, stream);
      if (got < free_bytes) break; /* the next call would say that there is no more */
    } else if (got == 0 || (errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR)) {
      atomic_store_explicit(&stream->state, CUT, memory_order_release);
      shutdown((int)stream->fd, SHUT_WR); /* the other end waits for that: now it knows that all has come */
    } else if (errno != EINTR) {
      break;
    }
  }
  if (any) stream->heard_ns = now();
  return any;
}

int streams_read(Streams *streams) {
  int any = 0;
  for (int64_t i = 0; i < streams->n_streams; i++) any |= read_stream(&streams->place, &streams->streams[i]);
  return any;
}

/* ---- waiting */

static int granted(const Wish *wishes, int64_t n) {
  for (int64_t i = 0; i < n; i++)
    if (wishes[i].counter != NULL && value_of(wishes[i].counter) >= wishes[i].need) return 1;
  return 0;
}

static void futex_wait(Bell *bell, uint32_t seen, int64_t limit_ns, int *is_late) {
  const struct timespec limit = {limit_ns / 1000000000, limit_ns % 1000000000};
  *is_late = syscall(SYS_futex, &bell->rung, FUTEX_WAIT, seen, &limit, NULL, 0) != 0 && errno == ETIMEDOUT;
}

/* Whether Python does not know yet that a stream was cut, or that no more rows of a link come. */
static int needs_python(const Streams *streams) {
  for (int64_t i = 0; i < streams->n_streams; i++) {
    const Stream *stream = &streams->streams[i];
    if (stream->has_ended || (!is_open(stream) && !stream->is_known)) return 1;
  }
  return 0;
}

/* Whether a stream has something that may wait, and when it does not wait any more. */
static int64_t due_ns(const Streams *streams) {
  int64_t due = NEVER;
  for (int64_t i = 0; i < streams->n_streams; i++) {
    const Stream *stream = &streams->streams[i];
    const int64_t own = atomic_load_explicit(&stream->flushed_ns, memory_order_relaxed) + streams->lazy_ns;
    if (own < due && is_open(stream) && has_new(stream)) due = own;
  }
  return due;
}

/* Wait for the sockets and for the bell until a wish is granted, and take what comes. */
static void poll_streams(Streams *streams, Bell *bell, uint32_t seen, const Wish *wishes, int64_t n_wishes,
                         int64_t limit_ns) {
  const int64_t end = now() + limit_ns;
  struct pollfd *polled = streams->polled;
  for (;;) {
    atomic_store_explicit(&bell->polls, 1, memory_order_release); /* after where the pipe is: see `ring_pipe` */
    atomic_thread_fence(memory_order_seq_cst);
    if (atomic_load_explicit(&bell->rung, memory_order_acquire) != seen || granted(wishes, n_wishes)) return;
    int64_t n = 0, until = end;
    polled[n++] = (struct pollfd){(int)streams->bell_pipe, POLLIN, 0};
    for (int64_t i = 0; i < streams->n_streams; i++)
      if (is_open(&streams->streams[i]))
        polled[n++] = (struct pollfd){(int)streams->streams[i].fd, POLLIN, 0};
    const int64_t due = due_ns(streams);
    if (due < until) until = due;
    int64_t left = until - now();
    if (left < 0) left = 0;
    const struct timespec limit = {left / 1000000000, left % 1000000000};
    const int ready = ppoll(polled, (nfds_t)n, &limit, NULL);
    atomic_store_explicit(&bell->polls, 0, memory_order_relaxed); /* what it reads rings its own bell: this needs no pipe */
    if (ready > 0 && polled[0].revents != 0) {
      char bytes[64];
      while (read((int)streams->bell_pipe, bytes, sizeof bytes) == (ssize_t)sizeof bytes) continue;
    }
    if (ready > 0)
      streams_read(streams);
    else if (now() >= end)
      return;
    else
      streams_write(streams, 1);
    if (needs_python(streams)) return;
  }
}

int64_t sleep_on(const Place *place, Streams *streams, uint32_t seen, const Wish *wishes, int64_t n, int64_t limit_ns,
                 int64_t *late) {
  Bell *bell = &place->bells[place->own];
  for (int64_t i = 0; i < n; i++) {
    Counter *counter = wishes[i].counter;
    if (counter == NULL) continue;
    int64_t other = atomic_load_explicit(&counter->needs[place->own], memory_order_relaxed);
    if (other == 0 || other > wishes[i].need) /* seq_cst: before `wake_at`, see `lower` */
      atomic_store_explicit(&counter->needs[place->own], wishes[i].need, memory_order_seq_cst);
    lower(&counter->wake_at, wishes[i].need);
  }
  atomic_thread_fence(memory_order_seq_cst);
  int is_granted = granted(wishes, n), is_late = 0;
  if (!is_granted && streams != NULL) {
    poll_streams(streams, bell, seen, wishes, n, limit_ns);
    atomic_store_explicit(&bell->polls, 0, memory_order_relaxed);
    is_granted = granted(wishes, n);
  } else if (!is_granted) {
    futex_wait(bell, seen, limit_ns, &is_late);
    is_granted = granted(wishes, n);
    if (is_granted && late != NULL && is_late) {
      /* The value came as the time was over. Its writer is about to ring; if it does not, this wake-up was lost. */
      futex_wait(bell, seen, 10000000, &is_late);
      *late += is_late;
    }
  }
  for (int64_t i = 0; i < n; i++)
    if (wishes[i].counter != NULL)
      atomic_store_explicit(&wishes[i].counter->needs[place->own], 0, memory_order_seq_cst);
  return is_granted;
}

PUBLIC int64_t sleep_for(const Place *place, uint32_t seen, const Wish *wishes, int64_t n, int64_t limit_ns,
                         int64_t *late) {
  return sleep_on(place, NULL, seen, wishes, n, limit_ns, late);
}

/* ---- for Python */

/* Move rows and counters for `limit_ns`, or until the bell is rung or a stream needs Python: the work of a thread that
 * does nothing else. */
PUBLIC void streams_serve(Streams *streams, int64_t limit_ns) {
  const int64_t end = now() + limit_ns;
  Wish *wishes = streams->wishes;
  for (;;) {
    const uint32_t seen = atomic_load_explicit(&streams->place.bells[streams->place.own].rung, memory_order_acquire);
    streams_read(streams);
    streams_write(streams, 1);
    int64_t n = 0;
    if (needs_python(streams)) return;
    for (int64_t i = 0; i < streams->n_streams; i++) {
      const Stream *stream = &streams->streams[i];
      for (int64_t j = 0; j < stream->n_told; j++)
        if (stream->told[j].stride > 0) {
          const int64_t sent = atomic_load_explicit(&stream->told[j].sent, memory_order_relaxed);
          wishes[n++] = (Wish){stream->told[j].counter, sent + stream->told[j].stride};
        }
    }
    const int64_t left = end - now();
    if (left <= 0 || atomic_exchange_explicit(&streams->attention, 0, memory_order_seq_cst)) return;
    sleep_on(&streams->place, streams, seen, wishes, n, left, NULL);
  }
}

/* From any thread: tell the other process that this one lives, and all that is new. */
PUBLIC void stream_beat(Stream *stream) {
  if (!is_open(stream) || !take_flag_or_ask(stream)) return;
  if (room(stream) >= 0) put_header(stream, ALIVE, 0, 0, 0);
  send_and_release(stream, 1);
}

/* Shut the socket down, wait for the thread that may send, and keep the flag: from now on nobody uses the stream. */
PUBLIC void stream_hold(Stream *stream) {
  atomic_store_explicit(&stream->state, CUT, memory_order_release);
  shutdown((int)stream->fd, SHUT_RDWR);
  while (!take_flag(stream)) sched_yield();
}

/* Go on with a new socket; Python has set how many rows the other process has. */
PUBLIC void stream_open(Stream *stream, int64_t fd) {
  stream->fd = fd;
  stream->send_from = stream->send_to = stream->used = stream->filled = stream->rows_left = 0;
  for (int64_t i = 0; i < stream->n_told; i++) atomic_store_explicit(&stream->told[i].sent, -1, memory_order_relaxed);
  stream->heard_ns = now();
  atomic_store_explicit(&stream->flushed_ns, stream->heard_ns, memory_order_relaxed);
  stream->is_known = 0;
  atomic_store_explicit(&stream->state, OPEN, memory_order_release);
  atomic_store_explicit(&stream->sending, 0, memory_order_release);
}

/* Who rings the bell while this process polls writes into a pipe, of which this process has this descriptor. */
PUBLIC void streams_listen(Streams *streams, int64_t process, int64_t pipe) {
  Bell *bell = &streams->place.bells[streams->place.own];
  atomic_store_explicit(&bell->process, (int32_t)process, memory_order_relaxed); /* `polls` comes after both */
  atomic_store_explicit(&bell->pipe, (int32_t)pipe, memory_order_relaxed);
}
