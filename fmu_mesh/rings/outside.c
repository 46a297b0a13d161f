/* An instance whose steps come from a program that we did not start: both ends of the memory that they share.
 *
 * Who meets here: one thread of the program (outside.h), and the thread of the node that steps its instances; the node
 * calls `outside_put`, `outside_do_step` and `outside_take` as it calls functions of an FMU, so the burst knows nothing
 * of this. The memory has values and a word `turn`: whose turn it is may read and write the values, and nobody else.
 * To pass the turn is a release, to see it an acquire. Who waits spins for a moment, and then sleeps on `turn` (futex).
 *
 *   waiter: sleeps = 1; FENCE; turn is still the other's? futex_wait(turn)     other: turn = waiter's; FENCE; sleeps? wake
 *
 * What may go wrong: the other side is killed. Their socket ends then, and a sleeper looks at it twenty times a second.
 * The node does not wait longer than a slice at once: it returns OUTSIDE_PENDING, does what else there is (a pause, the
 * end of the run), and calls again. Then nothing is set again: the program may be reading it. Tried and given up: two
 * counters as in hosted.c, which say no more than whose turn it is; bytes through a pipe, which cost a system call each
 * (ADR 103). */
#define _GNU_SOURCE
#include <fcntl.h>
#include <glob.h>
#include <limits.h>
#include <linux/futex.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "outside.h"

#define PUBLIC __attribute__((visibility("default")))

enum { OF_NODE = 1, OF_PROGRAM = 2 };                /* OutsideMemory.turn */
enum { RUNS, DETACHED, ENDED };                      /* OutsideMemory.state */
enum { PENDING = 200, DIED = 201, LEFT = 202 };      /* what outside_do_step returns to the node */
enum { SPIN_NS = 20000, LOOK_NS = 50000000, TRY_NS = 50000000, TEXT = 4096 };

typedef struct { /* at its place in the memory, written by the node before the program attaches */
  char name[256];
  int64_t type, is_output, elements, values, bytes; /* where its values are, in bytes */
} OutsideVariable;

typedef struct { /* the first bytes of the memory; then come the variables, and then their values */
  int64_t version, size, n_variables, points; /* points of the mesh for each step */
  double start_time, base_step_size;
  char unused[16];
  _Atomic uint32_t turn, state;
  _Atomic uint32_t node_sleeps, program_sleeps;
  char beside[48];
  char text[512]; /* why the run has ended */
  OutsideVariable variables[];
} OutsideMemory;

typedef struct { /* the end of the node; Python makes it */
  OutsideMemory *memory;
  int64_t socket, slice_ns;
  _Atomic int64_t pending_ns; /* since when the program has the turn; 0: it has not */
} OutsideNode;

struct Outside {
  OutsideMemory *memory;
  int socket, has_begun;
  int64_t size, step;
  char error[600];
};

/* ---- passing the turn */

static int64_t time_ns(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static void pass_turn(OutsideMemory *memory, uint32_t to) {
  _Atomic uint32_t *sleeps = to == OF_NODE ? &memory->node_sleeps : &memory->program_sleeps;
  /* seq_cst, as in `await_turn`: of the two sides, one sees what the other has stored */
  atomic_store_explicit(&memory->turn, to, memory_order_seq_cst);
  if (atomic_load_explicit(sleeps, memory_order_seq_cst)) syscall(SYS_futex, &memory->turn, FUTEX_WAKE, INT_MAX, NULL, NULL, 0);
}

static int has_turn(const OutsideMemory *memory, uint32_t own) {
  return atomic_load_explicit(&memory->turn, memory_order_acquire) == own;
}

/* Whether the process at the other end of a socket lives. */
static int lives(int fd) {
  char byte;
  return recv(fd, &byte, 1, MSG_PEEK | MSG_DONTWAIT) != 0;
}

/* Wait for the turn up to a time. */
static int await_turn(OutsideMemory *memory, uint32_t own, int64_t until) {
  _Atomic uint32_t *sleeps = own == OF_NODE ? &memory->node_sleeps : &memory->program_sleeps;
  const int64_t spin_until = time_ns() + SPIN_NS;
  for (int i = 0; !has_turn(memory, own); i++) {
    const int64_t now = i & 15 ? 0 : time_ns();
    if (now < spin_until) {
      if (i % 64 == 63) sched_yield();
      continue;
    }
    if (now >= until) return 0;
    const int64_t left = until - now;
    const struct timespec limit = {left / 1000000000, left % 1000000000};
    atomic_store_explicit(sleeps, 1, memory_order_seq_cst);
    if (atomic_load_explicit(&memory->turn, memory_order_seq_cst) != own)
      syscall(SYS_futex, &memory->turn, FUTEX_WAIT, own == OF_NODE ? OF_PROGRAM : OF_NODE, &limit, NULL, 0);
    atomic_store_explicit(sleeps, 0, memory_order_seq_cst);
    i = -1; /* so it looks at the time next */
  }
  return 1;
}

/* ---- the node: setters, doStep and getters as of FMI 2.0 */

/* A reference is the place of the values and their size, in bytes. */
PUBLIC int outside_put(OutsideNode *own, const int64_t *place, size_t count, const void *values) {
  (void)count;
  if (atomic_load_explicit(&own->pending_ns, memory_order_relaxed) == 0)
    memcpy((char *)own->memory + place[0], values, (size_t)place[1]);
  return 0;
}

PUBLIC int outside_take(OutsideNode *own, const int64_t *place, size_t count, void *values) {
  (void)count;
  memcpy(values, (char *)own->memory + place[0], (size_t)place[1]);
  return 0;
}

/* Whether the program has passed the turn to the node, within a slice: 0, or why not. */
PUBLIC int outside_await(OutsideNode *own) {
  OutsideMemory *memory = own->memory;
  if (await_turn(memory, OF_NODE, time_ns() + own->slice_ns)) {
    atomic_store_explicit(&own->pending_ns, 0, memory_order_relaxed);
    return 0;
  }
  return lives((int)own->socket) || has_turn(memory, OF_NODE) ? PENDING : DIED;
}

PUBLIC int outside_do_step(OutsideNode *own, double time, double step_size, int no_set_before) {
  (void)time, (void)step_size, (void)no_set_before;
  if (atomic_load_explicit(&own->pending_ns, memory_order_relaxed) == 0) {
    if (atomic_load_explicit(&own->memory->state, memory_order_acquire) == DETACHED) return LEFT;
    atomic_store_explicit(&own->pending_ns, time_ns(), memory_order_relaxed);
    pass_turn(own->memory, OF_PROGRAM);
  }
  return outside_await(own);
}

/* For Python: as `pass_turn`. */
PUBLIC void outside_pass(OutsideMemory *memory, uint32_t to) { pass_turn(memory, to); }

/* The run has ended; `text` says why. */
PUBLIC void outside_close(OutsideMemory *memory, const char *text) {
  snprintf(memory->text, sizeof memory->text, "%s", text);
  atomic_store_explicit(&memory->state, ENDED, memory_order_release);
  pass_turn(memory, OF_PROGRAM);
}

/* ---- the program: to attach */

#define FAIL(...) (snprintf(error, error_size, __VA_ARGS__), NULL)

/* Connect to the socket in a folder; the path of the folder may be longer than that of a socket may be. */
static int connect_in(const char *folder, const char *name) {
  const int at = open(folder, O_PATH | O_DIRECTORY | O_CLOEXEC), fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  struct sockaddr_un address = {.sun_family = AF_UNIX};
  snprintf(address.sun_path, sizeof address.sun_path, "/proc/self/fd/%d/%.60s", at, name);
  const int failed = at < 0 || fd < 0 || connect(fd, (const struct sockaddr *)&address, sizeof address) != 0;
  if (at >= 0) close(at);
  if (failed && fd >= 0) close(fd);
  return failed ? -1 : fd;
}

/* Where the sockets of an instance may be: see fmu_mesh/wire/runtime.py. */
static int pattern_of(const char *address, char *pattern, size_t size) {
  const char *slash = strchr(address, '/'), *chosen = getenv("FMU_MESH_RUNTIME_DIR"), *base = getenv("XDG_RUNTIME_DIR");
  char folder[PATH_MAX];
  struct stat about;
  if (address[0] == '/') return snprintf(pattern, size, "%s", address) < (int)size;
  if (slash == NULL || strpbrk(address, "*?[.") != NULL) return 0;
  if (chosen != NULL && chosen[0])
    snprintf(folder, sizeof folder, "%s", chosen);
  else if (base != NULL && stat(base, &about) == 0 && about.st_uid == getuid())
    snprintf(folder, sizeof folder, "%s/fmu_mesh", base);
  else
    snprintf(folder, sizeof folder, "%s/fmu_mesh-%u", getenv("TMPDIR") ? getenv("TMPDIR") : "/tmp", getuid());
  const int length = (int)(slash - address);
  const int kept = length > 40 ? 31 : length;
  return snprintf(pattern, size, "%s/%.*s%s*/fmus/*/%s.outside", folder, kept, address, length > 40 ? "-" : ".",
                  slash + 1) < (int)size;
}

/* The memory that the node sends; -1 and a sentence if it refuses. */
static int receive_memory(int fd, char *text, size_t size) {
  union {
    struct cmsghdr header;
    char room[CMSG_SPACE(sizeof(int))];
  } control;
  struct iovec piece = {text, size - 1};
  struct msghdr message = {.msg_iov = &piece, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
  const ssize_t received = recvmsg(fd, &message, MSG_CMSG_CLOEXEC);
  text[received > 0 ? received : 0] = 0;
  const struct cmsghdr *first = received > 0 ? CMSG_FIRSTHDR(&message) : NULL;
  int memory = -1;
  if (first != NULL && first->cmsg_type == SCM_RIGHTS) memcpy(&memory, CMSG_DATA(first), sizeof memory);
  return memory;
}

PUBLIC Outside *outside_attach(const char *address, int64_t timeout_ns, char *error, size_t error_size) {
  char pattern[PATH_MAX], text[600] = "", own_error[600];
  const int64_t until = time_ns() + timeout_ns;
  int fd = -1;
  if (error == NULL) error = own_error, error_size = sizeof own_error;
  if (address == NULL && (address = getenv("FMU_MESH_CONNECT")) == NULL)
    return FAIL("there is no address, and the environment variable FMU_MESH_CONNECT is not set");
  if (!pattern_of(address, pattern, sizeof pattern))
    return FAIL("'%s' is no address: expected mesh/instance, or the path of a socket", address);
  for (;;) {
    glob_t found = {0};
    if (glob(pattern, 0, NULL, &found) == 0)
      for (size_t i = 0; fd < 0 && i < found.gl_pathc; i++) {
        char *slash = strrchr(found.gl_pathv[i], '/');
        *slash = 0;
        fd = connect_in(found.gl_pathv[i], slash + 1);
      }
    globfree(&found);
    if (fd >= 0 || time_ns() >= until) break;
    nanosleep(&(struct timespec){0, TRY_NS}, NULL);
  }
  if (fd < 0) return FAIL("no running mesh of this user has the instance '%s' of the kind outside", address);
  const int memory_fd = receive_memory(fd, text, sizeof text);
  struct stat about;
  Outside *own = calloc(1, sizeof *own);
  void *memory = memory_fd < 0 || fstat(memory_fd, &about) != 0 || own == NULL
                     ? MAP_FAILED
                     : mmap(NULL, (size_t)about.st_size, PROT_READ | PROT_WRITE, MAP_SHARED, memory_fd, 0);
  if (memory_fd >= 0) close(memory_fd);
  if (memory == MAP_FAILED || ((OutsideMemory *)memory)->version != OUTSIDE_VERSION) {
    const int is_other = memory != MAP_FAILED;
    if (is_other) munmap(memory, (size_t)about.st_size);
    close(fd);
    free(own);
    if (is_other) return FAIL("the mesh and this program have other versions of outside.h");
    return FAIL("the instance '%s' refuses: %s", address, text[0] ? text : "its run has just ended");
  }
  *own = (Outside){.memory = memory, .socket = fd, .size = (int64_t)about.st_size};
  return own;
}

/* ---- the program: variables */

static const OutsideVariable *variable(const Outside *own, int64_t index) {
  return index >= 0 && index < own->memory->n_variables ? &own->memory->variables[index] : NULL;
}

PUBLIC int64_t outside_count(const Outside *own) { return own->memory->n_variables; }

PUBLIC int64_t outside_index(const Outside *own, const char *name) {
  for (int64_t i = 0; i < own->memory->n_variables; i++)
    if (strcmp(own->memory->variables[i].name, name) == 0) return i;
  return -1;
}

PUBLIC const char *outside_name(const Outside *own, int64_t index) {
  return variable(own, index) != NULL ? variable(own, index)->name : NULL;
}

PUBLIC int outside_type(const Outside *own, int64_t index) {
  return variable(own, index) != NULL ? (int)variable(own, index)->type : -1;
}

PUBLIC int outside_is_output(const Outside *own, int64_t index) {
  return variable(own, index) != NULL && variable(own, index)->is_output;
}

PUBLIC int64_t outside_elements(const Outside *own, int64_t index) {
  return variable(own, index) != NULL ? variable(own, index)->elements : 0;
}

/* Where the values of a variable are; NULL, with the reason, if it may not be used so. */
static char *values_of(Outside *own, int64_t index, int64_t n, int first, int last, int to_set) {
  const OutsideVariable *found = variable(own, index);
  if (found == NULL)
    snprintf(own->error, sizeof own->error, "there is no variable %lld", (long long)index);
  else if (found->type < first || found->type > last)
    snprintf(own->error, sizeof own->error, "'%s' has another type", found->name);
  else if (found->elements != n)
    snprintf(own->error, sizeof own->error, "'%s' has %lld elements, not %lld", found->name, (long long)found->elements,
             (long long)n);
  else if (to_set && !found->is_output)
    snprintf(own->error, sizeof own->error, "'%s' is an input of the instance: the mesh sets it", found->name);
  else
    return (char *)own->memory + found->values;
  return NULL;
}

PUBLIC int outside_set_float64(Outside *own, int64_t index, const double *values, int64_t n) {
  char *to = values_of(own, index, n, OUTSIDE_FLOAT64, OUTSIDE_FLOAT32, 1);
  if (to == NULL) return OUTSIDE_WRONG;
  for (int64_t i = 0; i < n; i++)
    if (variable(own, index)->type == OUTSIDE_FLOAT64)
      ((double *)(void *)to)[i] = values[i];
    else
      ((float *)(void *)to)[i] = (float)values[i];
  return OUTSIDE_OK;
}

PUBLIC int outside_get_float64(Outside *own, int64_t index, double *values, int64_t n) {
  const char *from = values_of(own, index, n, OUTSIDE_FLOAT64, OUTSIDE_FLOAT32, 0);
  if (from == NULL) return OUTSIDE_WRONG;
  for (int64_t i = 0; i < n; i++)
    values[i] = variable(own, index)->type == OUTSIDE_FLOAT64 ? ((const double *)(const void *)from)[i]
                                                             : (double)((const float *)(const void *)from)[i];
  return OUTSIDE_OK;
}

#define INTEGERS(X)                                                                                                   \
  X(OUTSIDE_INT8, int8_t, INT8_MIN, INT8_MAX) X(OUTSIDE_UINT8, uint8_t, 0, UINT8_MAX)                                  \
  X(OUTSIDE_INT16, int16_t, INT16_MIN, INT16_MAX) X(OUTSIDE_UINT16, uint16_t, 0, UINT16_MAX)                           \
  X(OUTSIDE_INT32, int32_t, INT32_MIN, INT32_MAX) X(OUTSIDE_UINT32, uint32_t, 0, UINT32_MAX)                           \
  X(OUTSIDE_INT64, int64_t, INT64_MIN, INT64_MAX) X(OUTSIDE_UINT64, uint64_t, 0, INT64_MAX)                            \
  X(OUTSIDE_BOOLEAN, uint8_t, 0, 1)

PUBLIC int outside_set_int64(Outside *own, int64_t index, const int64_t *values, int64_t n) {
  char *to = values_of(own, index, n, OUTSIDE_INT8, OUTSIDE_BOOLEAN, 1);
  if (to == NULL) return OUTSIDE_WRONG;
#define SET(TYPE, C, LEAST, MOST)                                                                                     \
  case TYPE:                                                                                                          \
    for (int64_t i = 0; i < n; i++)                                                                                   \
      if (values[i] < LEAST || values[i] > MOST) goto wrong;                                                          \
    for (int64_t i = 0; i < n; i++) ((C *)(void *)to)[i] = (C)values[i];                                              \
    break;
  switch (variable(own, index)->type) { INTEGERS(SET) }
  return OUTSIDE_OK;
wrong:
  snprintf(own->error, sizeof own->error, "a value of '%s' does not fit into its type", variable(own, index)->name);
  return OUTSIDE_WRONG;
}

PUBLIC int outside_get_int64(Outside *own, int64_t index, int64_t *values, int64_t n) {
  const char *from = values_of(own, index, n, OUTSIDE_INT8, OUTSIDE_BOOLEAN, 0);
  if (from == NULL) return OUTSIDE_WRONG;
#define GET(TYPE, C, LEAST, MOST)                                                                                     \
  case TYPE:                                                                                                          \
    for (int64_t i = 0; i < n; i++) values[i] = (int64_t)((const C *)(const void *)from)[i];                          \
    break;
  switch (variable(own, index)->type) { INTEGERS(GET) }
  return OUTSIDE_OK;
}

PUBLIC int outside_set_string(Outside *own, int64_t index, const char *value) {
  char *to = values_of(own, index, 1, OUTSIDE_STRING, OUTSIDE_STRING, 1);
  if (to == NULL) return OUTSIDE_WRONG;
  if (strlen(value) >= TEXT) {
    snprintf(own->error, sizeof own->error, "a String has at most %d bytes", TEXT - 1);
    return OUTSIDE_WRONG;
  }
  memcpy(to, value, strlen(value) + 1);
  return OUTSIDE_OK;
}

PUBLIC int outside_get_string(Outside *own, int64_t index, const char **value) {
  return (*value = values_of(own, index, 1, OUTSIDE_STRING, OUTSIDE_STRING, 0)) != NULL ? OUTSIDE_OK : OUTSIDE_WRONG;
}

/* ---- the program: steps */

static int hand_over(Outside *own) {
  OutsideMemory *memory = own->memory;
  if (atomic_load_explicit(&memory->state, memory_order_acquire) != ENDED) pass_turn(memory, OF_NODE);
  while (!await_turn(memory, OF_PROGRAM, time_ns() + LOOK_NS))
    if (!lives(own->socket) && !has_turn(memory, OF_PROGRAM)) {
      snprintf(own->error, sizeof own->error, "the node of the instance has ended without a word");
      return OUTSIDE_LOST;
    }
  if (atomic_load_explicit(&memory->state, memory_order_acquire) != ENDED) return OUTSIDE_OK;
  snprintf(own->error, sizeof own->error, "%.511s", memory->text);
  return OUTSIDE_ENDED;
}

PUBLIC int outside_begin(Outside *own) {
  if (own->has_begun) {
    snprintf(own->error, sizeof own->error, "outside_begin is called once, before the first step");
    return OUTSIDE_WRONG;
  }
  own->has_begun = 1;
  return hand_over(own);
}

PUBLIC int outside_step(Outside *own, int64_t steps) {
  int result = own->has_begun ? OUTSIDE_OK : outside_begin(own);
  for (int64_t i = 0; i < steps && result == OUTSIDE_OK; i++)
    if ((result = hand_over(own)) == OUTSIDE_OK) own->step++;
  return result;
}

PUBLIC int64_t outside_point(const Outside *own) { return own->step * own->memory->points; }

PUBLIC double outside_time(const Outside *own) {
  return own->memory->start_time + (double)outside_point(own) * own->memory->base_step_size;
}

PUBLIC double outside_step_size(const Outside *own) {
  return (double)own->memory->points * own->memory->base_step_size;
}

PUBLIC const char *outside_error(const Outside *own) { return own->error; }

PUBLIC void outside_detach(Outside *own) {
  if (own == NULL) return;
  uint32_t runs = RUNS;
  if (atomic_compare_exchange_strong_explicit(&own->memory->state, &runs, DETACHED, memory_order_seq_cst,
                                              memory_order_seq_cst))
    pass_turn(own->memory, OF_NODE);
  munmap(own->memory, (size_t)own->size);
  close(own->socket);
  free(own);
}
