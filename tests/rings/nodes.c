/* Nodes of `burst.c` over one memory, as threads of this process or as processes that are killed: for sanitizers, for
 * lost wake-ups, and for the cost of the loop itself. docs/rings.md says what is checked.
 *
 *   nodes SHAPE NODES WINDOW POINTS SECONDS MODE
 *
 *   SHAPE   chain: each node reads the one before it at the same point. cycle: the first also reads the last, one point
 *           before. jacobi: a cycle in which all read one point before
 *   MODE    quiet: threads, nothing else happens. disturbed: a master that grants little, attention, bells that nobody
 *           needs, needs that a killed sleeper has left. forged: threads, and somebody writes wrong counters. killed:
 *           processes that are stopped, or killed and started again, at random moments. streamed: threads of which each has a
 *           memory of its own, and streams to its neighbours with small buffers. cut: the same, and somebody replaces their
 *           connections at random moments, also by one that knows only what the reader had some time ago
 *
 * Runs of POINTS points follow each other for SECONDS. The rings are as small as the window allows. Each float is
 * compared with those of a plain loop. Prints `runs R late L wrong W us U best B`: lost wake-ups, runs with a wrong
 * value, median and least time per point. Ends with code 1 if something is wrong, and by a signal if a run stops. */
#ifndef BURST
#define BURST "../../fmu_mesh/rings/burst.c"
#endif
#include BURST

#include "../../fmu_mesh/rings/streams.c"

#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

/* No model of these nodes is in another process. */
int64_t hosted_step(Member *member, int64_t step) { return (void)member, step; }

int hosted_advance(Node *node, Unit *unit, int64_t *ticks) { return (void)node, (void)unit, (void)ticks, NOT_HOSTED; }

enum { MAX_NODES = 16, ROW_BYTES = 16, MAX_RUNS = 1 << 16 };

typedef struct { /* y(k+1) of a model depends on all its inputs until then, in every bit */
  double u, y;
} Model;

static int set_real(void *model, const void *references, size_t n, void *values) {
  (void)references, (void)n;
  memcpy(&((Model *)model)->u, values, 8);
  return 0;
}

static int do_step(void *instance, double time, double step_size, int no_set_state) {
  (void)step_size, (void)no_set_state;
  Model *model = instance;
  double y = model->y * 1.618033988749895 + model->u * 0.7071067811865476 + time;
  model->y = y - (double)(int64_t)y;
  return 0;
}

static int get_real(void *model, const void *references, size_t n, void *values) {
  (void)references, (void)n;
  memcpy(values, &((Model *)model)->y, 8);
  return 0;
}

/* ---- the memory */

static int64_t n_nodes, window, points, rows, is_chain, is_jacobi;
static char *memory; /* streamed: that of the node which is being looked at */
static char *memories[MAX_NODES];
static double *expected; /* all rows of all nodes */
static double times[MAX_RUNS];     /* of the runs, in us per point */

static size_t counter_bytes(void) { return (size_t)(64 + (8 * (n_nodes + 1) + 63) / 64 * 64); }
static Bell *bells(void) { return (Bell *)(void *)memory; }
static Counter *counter_at(int64_t i) {
  return (Counter *)(void *)(memory + 64 * (size_t)(n_nodes + 1) + counter_bytes() * (size_t)i);
}
static Counter *rows_of(int64_t i) { return counter_at(i); }
static Counter *progress_of(int64_t i) { return counter_at(n_nodes + i); }
static Counter *ceiling(void) { return counter_at(2 * n_nodes); }
static char *ring_of(int64_t i) { return (char *)counter_at(2 * n_nodes + 1) + rows * ROW_BYTES * i; }
static size_t memory_bytes(void) {
  return (size_t)(64 * (n_nodes + 1) + rows * ROW_BYTES * n_nodes) + counter_bytes() * (size_t)(2 * n_nodes + 1);
}

static double start_of(int64_t i) { return 0.1 + 0.05 * (double)i; }
static int64_t source_of(int64_t i) { return i > 0 ? i - 1 : is_chain ? -1 : n_nodes - 1; }
static int64_t lead_of(int64_t i) { return is_jacobi || i == 0 ? 0 : 1; }

static void prepare(int64_t granted_points) {
  memset(memory, 0, memory_bytes());
  for (int64_t i = 0; i < 2 * n_nodes + 1; i++) {
    atomic_store(&counter_at(i)->wake_at, NEVER);
    atomic_store(&counter_at(i)->value, i < 2 * n_nodes ? 1 : granted_points);
  }
  for (int64_t i = 0; i < n_nodes; i++) {
    double y = start_of(i);
    memcpy(ring_of(i) + 8, &y, 8);
    atomic_store(stamp_of(ring_of(i), ROW_BYTES, rows - 1, 0), 1);
  }
}

static void compute_expected(void) {
  Model models[MAX_NODES] = {0};
  for (int64_t i = 0; i < n_nodes; i++) expected[i] = models[i].y = start_of(i);
  for (int64_t k = 0; k < points; k++)
    for (int64_t i = 0; i < n_nodes; i++) {
      int64_t source = source_of(i);
      if (source >= 0) models[i].u = expected[(k + lead_of(i)) * n_nodes + source];
      do_step(&models[i], (double)k, 1.0, 1);
      expected[(k + 1) * n_nodes + i] = models[i].y;
    }
}

/* Whether all rows that have a stamp are right. */
static int is_right(void) {
  for (int64_t i = 0; i < n_nodes; i++)
    for (int64_t slot = 0; slot < rows; slot++) {
      int64_t row = atomic_load(stamp_of(ring_of(i), ROW_BYTES, rows - 1, slot)) - 1;
      if (row > points) return 0;
      if (row >= 0 && memcmp(ring_of(i) + slot * ROW_BYTES + 8, &expected[row * n_nodes + i], 8) != 0) return 0;
    }
  return 1;
}

/* Whether all nodes have come to the end. */
static int is_complete(void) {
  for (int64_t i = 0; i < n_nodes; i++)
    if (value_of(rows_of(i)) != points + 1 || value_of(progress_of(i)) != points + 1) return 0;
  return 1;
}

/* ---- a node */

typedef struct {
  int64_t own;
  Node node;
  Unit unit;
  Member member;
  Gate gate;
  Peer peers[1];
  Move load;
  Call setter, getter;
  Said said;
  Model model;
  double input;
  char *bases[FIRST_GATE + 1];
  uint64_t random;
} Participant;

static uint64_t draw(uint64_t *state) {
  *state ^= *state << 13, *state ^= *state >> 7, *state ^= *state << 17;
  return *state;
}

/* A node that goes on where its ring ends. */
static void set_up(Participant *p, int64_t own, int64_t wait_ns, int64_t spins) {
  int64_t source = source_of(own), step = value_of(rows_of(own)) - 1, readers = is_chain && own == n_nodes - 1 ? 0 : 1;
  memset(p, 0, sizeof *p);
  p->own = own;
  memcpy(&p->model.y, ring_of(own) + (step & (rows - 1)) * ROW_BYTES + 8, 8);
  if (source >= 0) {
    p->gate = (Gate){.counter = rows_of(source), .rows = ring_of(source), .stride = ROW_BYTES, .mask = rows - 1,
                     .lead = lead_of(own), .points = 1};
    p->load = (Move){.from_base = FIRST_GATE, .from = 8, .to_base = FIXED, .to = (int64_t)(uintptr_t)&p->input, .count = 1};
    p->setter = (Call){(void *)set_real, NULL, 1, FIXED, (int64_t)(uintptr_t)&p->input, -1};
  }
  p->getter = (Call){(void *)get_real, NULL, 1, OUTPUT, 8, -1};
  p->said.quiet_until = HUGE_VAL;
  p->member = (Member){.gates = &p->gate, .loads = &p->load, .setters = &p->setter, .getters = &p->getter,
                       .n_gates = source >= 0, .n_loads = source >= 0, .n_setters = source >= 0, .n_getters = 1,
                       .kind = FMI2, .component = &p->model, .do_step = (void *)do_step, .said = &p->said,
                       .base_step_size = 1.0, .step_size = 1.0, .points = 1, .every = 1, .last_step = points, .python_at = NEVER,
                       .outputs = {{ring_of(own), ROW_BYTES, rows - 1}}, .counter = rows_of(own), .bases = p->bases,
                       .step = step};
  p->member.outputs[1] = p->member.outputs[0];
  p->unit = (Unit){.members = &p->member, .n_members = 1, .tick_points = 1, .last_tick = points, .tick = step, .burst = 1};
  p->peers[0] = (Peer){progress_of((own + 1) % n_nodes), window};
  p->node = (Node){.place = {bells(), n_nodes + 1, own}, .units = &p->unit, .n_units = 1, .peers = p->peers,
                   .n_peers = readers, .ceiling = ceiling(), .progress = progress_of(own), .last_point = points,
                   .slice_ns = 1000000, .wait_ns = wait_ns, .spins = spins, .batch = is_chain ? window : 1, .stride = 1};
}

/* What a sleeper leaves that was killed. */
static void leave_need(Participant *p) {
  Counter *counter = draw(&p->random) & 1 ? rows_of((p->own + 1) % n_nodes) : ceiling();
  int64_t need = value_of(counter) + (int64_t)(draw(&p->random) % 4);
  if (need < 1) return;
  atomic_store(&counter->needs[p->own], need);
  lower(&counter->wake_at, need);
}

static uint64_t seed = 88172645463325252u;
static enum { QUIET, DISTURBED, FORGING, KILLED, STREAMED, CUTTING } mode;
static _Atomic int64_t is_over, n_forged, n_done;
static int64_t master_late, n_pauses, n_overrun;
static Participant participants[MAX_NODES];

static void go_on(Participant *p);

static void *run_node(void *argument) {
  Participant *p = argument;
  for (;;) {
    int64_t result = node_run(&p->node);
    if (mode == CUTTING) go_on(p);
    if (result == DONE && mode == CUTTING) {
      for (n_done++; n_done < n_nodes; go_on(p)) streams_serve((Streams *)p->node.streams, 1000000);
      return NULL;
    }
    if (result == DONE || (mode == FORGING && atomic_load(&is_over))) return NULL;
    if (result == FORGED && mode == FORGING) { /* end the run */
      n_forged++;
      atomic_store(&is_over, 1);
      for (int64_t i = 0; i < n_nodes; i++) node_attend(&participants[i].node);
      return NULL;
    }
    if (result != SLICE && result != ATTENTION && result != BLOCKED) abort();
    if (result == ATTENTION) node_attended(&p->node);
    if (mode == DISTURBED) leave_need(p);
  }
}

/* ---- a master, and somebody who disturbs */

/* Grants little, and now and then takes it back: then all nodes have to pause at the same point. */
static void *run_master(void *argument) {
  const Place place = {bells(), n_nodes + 1, n_nodes};
  uint64_t random = *(uint64_t *)argument;
  const int64_t ahead = 1 + (int64_t)(draw(&random) % 200);
  Counter *nodes[MAX_NODES];
  for (int64_t i = 0; i < n_nodes; i++) nodes[i] = progress_of(i);
  int64_t pause = -1, granted_points = 0;
  for (int64_t known = 0; known < points;) {
    uint32_t seen = bell_seen(&place);
    Wish wish = {NULL, 0};
    int64_t most = 0;
    known = points;
    for (int64_t i = 0; i < n_nodes; i++) {
      int64_t own = value_of(nodes[i]) - 1;
      if (own < known) wish = (Wish){nodes[i], (known = own) + 2};
      if (own > most) most = own;
    }
    if (pause >= 0 && most > pause) n_overrun++;
    if (pause >= 0 && known >= pause) pause = -1;
    if (pause < 0) {
      granted_points = known + ahead < points ? known + ahead : points;
      counter_raise(&place, ceiling(), granted_points);
      if (draw(&random) % 4 == 0 && known < points) {
        pause = grant_withdraw(ceiling(), nodes, n_nodes);
        if (pause > granted_points) pause = granted_points;
        counter_raise(&place, ceiling(), pause);
        n_pauses++;
        continue;
      }
    }
    if (known < points) sleep_for(&place, seen, &wish, 1, 1000000000, &master_late);
  }
  return NULL;
}

static void *disturb(void *argument) {
  uint64_t random = *(uint64_t *)argument;
  while (!atomic_load(&is_over)) {
    struct timespec pause = {0, (long)(draw(&random) % 200000)};
    nanosleep(&pause, NULL);
    Participant *p = &participants[draw(&random) % (uint64_t)n_nodes];
    Counter *counter = draw(&random) & 1 ? rows_of(p->own) : progress_of(p->own);
    if (mode == FORGING)
      atomic_store(&counter->value, draw(&random) & 1 ? INT64_MAX : (int64_t)(draw(&random) % (uint64_t)points));
    else if (draw(&random) & 1)
      node_attend(&p->node);
    else
      ring_bell(&bells()[p->own]);
  }
  return NULL;
}

/* ---- a memory for each node, and streams */

enum { PER_NODE = 2, MOST_BYTES = 4096 };

typedef struct {
  Stream streams[PER_NODE];
  Streams all;
  Outgoing out[PER_NODE];
  Incoming in[PER_NODE];
  Told told[PER_NODE];
  Heard heard[PER_NODE];
  char buffers[2 * PER_NODE][MOST_BYTES];
  struct pollfd polled[PER_NODE + 1];
  Wish wishes[PER_NODE];
  int bell[2];
  struct {
    _Atomic int fd; /* of a new connection, or -1 */
    int64_t received;
  } next[PER_NODE];
} Ends;

static Ends ends[MAX_NODES];
static int64_t at_source[MAX_NODES], at_reader[MAX_NODES]; /* which stream of its nodes brings the rows for a node */
static int64_t n_cuts;
static Piece piece = {8, 8, 0};

/* One end of a stream: of the node that writes the rows, or of the one that reads them. */
static void add_end(int64_t own, int64_t source, int64_t reader, int fd) {
  Ends *e = &ends[own];
  const int64_t k = e->all.n_streams++, other = own == source ? reader : source;
  const int small = 4096;
  memory = memories[own];
  setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &small, sizeof small);
  e->out[k] = (Outgoing){source, rows_of(source), ring_of(source), ROW_BYTES, rows - 1, &piece, 1, 8, 0, 0, GOES_ON};
  e->in[k] = (Incoming){source, rows_of(source), ring_of(source), ROW_BYTES, rows - 1, &piece, 1, 8, points + 1, 0};
  e->told[k] = (Told){PROGRESS, own, progress_of(own), -1, window / 4 > 0 ? window / 4 : 1};
  e->heard[k] = (Heard){PROGRESS, other, progress_of(other), points + 1};
  const int64_t size = 64 + (int64_t)(draw(&seed) % (MOST_BYTES - 64));
  *(own == source ? &at_source[reader] : &at_reader[reader]) = k;
  e->next[k].fd = -1;
  e->streams[k] = (Stream){.outgoing = &e->out[k], .incoming = &e->in[k], .told = &e->told[k], .heard = &e->heard[k],
                           .n_outgoing = own == source, .n_incoming = own != source, .n_told = 1, .n_heard = 1,
                           .to_send = e->buffers[2 * k], .received = e->buffers[2 * k + 1], .send_size = size,
                           .receive_size = size, .state = CUT};
  stream_open(&e->streams[k], fd);
}

static void connect_nodes(void) {
  for (int64_t i = 0; i < n_nodes; i++) {
    ends[i].all = (Streams){.place = participants[i].node.place, .streams = ends[i].streams, .polled = ends[i].polled,
                            .wishes = ends[i].wishes, .lazy_ns = 5000000};
    if (pipe(ends[i].bell) != 0) abort();
    fcntl(ends[i].bell[0], F_SETFL, O_NONBLOCK);
    fcntl(ends[i].bell[1], F_SETFL, O_NONBLOCK);
    ends[i].all.bell_pipe = ends[i].bell[0];
    streams_listen(&ends[i].all, getpid(), ends[i].bell[1]);
    participants[i].node.streams = &ends[i].all;
  }
  for (int64_t i = 0; i < n_nodes; i++) {
    int both[2];
    if (source_of(i) < 0) continue;
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0, both) != 0) abort();
    add_end(source_of(i), source_of(i), i, both[0]);
    add_end(i, source_of(i), i, both[1]);
  }
}

/* Take what has come for the streams of a node, as `row_streams.py` does on the thread that reads them. */
static void go_on(Participant *p) {
  Ends *e = &ends[p->own];
  for (int64_t k = 0; k < e->all.n_streams; k++) {
    Stream *stream = &e->streams[k];
    const int fd = atomic_load(&e->next[k].fd);
    if (atomic_load(&stream->state) > CUT) abort();
    stream->is_known = 1;
    if (fd < 0) continue;
    stream_hold(stream);
    close((int)stream->fd);
    e->out[k].sent = e->next[k].received;
    stream_open(stream, fd);
    atomic_store(&e->next[k].fd, -1);
  }
}

/* Replaces connections until all nodes are at the end. */
static void *cut_streams(void *argument) {
  uint64_t random = *(uint64_t *)argument;
  while (atomic_load(&n_done) < n_nodes) {
    const int64_t i = (int64_t)(draw(&random) % (uint64_t)n_nodes), source = source_of(i);
    const int small = 4096;
    struct timespec before = {0, (long)(draw(&random) % 1000000)}, after = {0, (long)(draw(&random) % 300000)};
    int both[2];
    nanosleep(&before, NULL);
    if (source < 0 || atomic_load(&ends[source].next[at_source[i]].fd) >= 0) continue;
    if (atomic_load(&ends[i].next[at_reader[i]].fd) >= 0) continue;
    ends[source].next[at_source[i]].received = value_of(ends[i].in[at_reader[i]].counter);
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0, both) != 0) abort();
    for (int j = 0; j < 2; j++) setsockopt(both[j], SOL_SOCKET, SO_SNDBUF, &small, sizeof small);
    if (draw(&random) & 1) nanosleep(&after, NULL); /* what the reader has said is old by then */
    atomic_store(&ends[source].next[at_source[i]].fd, both[0]);
    atomic_store(&ends[i].next[at_reader[i]].fd, both[1]);
    node_attend(&participants[source].node);
    node_attend(&participants[i].node);
    n_cuts++;
  }
  return NULL;
}

/* Nobody's row or counter is on its way any more. */
static void disconnect_nodes(void) {
  for (int64_t i = 0; i < n_nodes; i++) {
    for (int64_t k = 0; k < ends[i].all.n_streams; k++) stream_hold(&ends[i].streams[k]);
  }
  for (int64_t i = 0; i < n_nodes; i++) {
    for (int64_t k = 0; k < ends[i].all.n_streams; k++) close((int)ends[i].streams[k].fd);
    for (int64_t k = 0; k < ends[i].all.n_streams; k++)
      if (ends[i].next[k].fd >= 0) close(ends[i].next[k].fd);
    close(ends[i].bell[0]);
    close(ends[i].bell[1]);
  }
}

static int run_streamed(int64_t *late) {
  pthread_t threads[MAX_NODES], cutter;
  uint64_t random = draw(&seed);
  int right = 1;
  n_done = 0;
  for (int64_t i = 0; i < n_nodes; i++) {
    memory = memories[i];
    prepare(points);
    set_up(&participants[i], i, 1000000000, draw(&seed) % 4 != 0);
  }
  connect_nodes();
  for (int64_t i = 0; i < n_nodes; i++) pthread_create(&threads[i], NULL, run_node, &participants[i]);
  if (mode == CUTTING) pthread_create(&cutter, NULL, cut_streams, &random);
  for (int64_t i = 0; i < n_nodes; i++) {
    pthread_join(threads[i], NULL);
    *late += participants[i].node.late;
  }
  if (mode == CUTTING) pthread_join(cutter, NULL);
  disconnect_nodes();
  for (int64_t i = 0; i < n_nodes; i++) {
    memory = memories[i];
    right &= is_right() && value_of(rows_of(i)) == points + 1 && value_of(progress_of(i)) == points + 1;
    if (source_of(i) >= 0) right &= value_of(rows_of(source_of(i))) >= points;
  }
  return right;
}

static int run_threads(int64_t *late) {
  pthread_t threads[MAX_NODES], master, disturber;
  uint64_t granting = draw(&seed), random = draw(&seed);
  prepare(mode == DISTURBED ? 0 : points);
  atomic_store(&is_over, 0);
  for (int64_t i = 0; i < n_nodes; i++) {
    set_up(&participants[i], i, 1000000000, draw(&seed) % 4 != 0);
    participants[i].random = draw(&seed);
  }
  for (int64_t i = 0; i < n_nodes; i++) pthread_create(&threads[i], NULL, run_node, &participants[i]);
  if (mode == DISTURBED) pthread_create(&master, NULL, run_master, &granting);
  if (mode != QUIET) pthread_create(&disturber, NULL, disturb, &random);
  for (int64_t i = 0; i < n_nodes; i++) {
    pthread_join(threads[i], NULL);
    *late += participants[i].node.late;
  }
  atomic_store(&is_over, 1);
  if (mode == DISTURBED) pthread_join(master, NULL);
  if (mode != QUIET) pthread_join(disturber, NULL);
  *late += master_late;
  master_late = 0;
  return is_right() && n_overrun == 0 && (mode == FORGING || is_complete());
}

/* ---- processes that are killed */

static pid_t start_process(int64_t own) {
  pid_t pid = fork();
  if (pid != 0) return pid;
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  set_up(&participants[own], own, 20000000, 1);
  run_node(&participants[own]);
  _exit(0);
}

/* Kills 20 times or more, and then lets all come to their end. */
static int run_processes(int64_t *kills) {
  pid_t pids[MAX_NODES];
  int64_t alive = n_nodes, budget = 20;
  prepare(points);
  for (int64_t i = 0; i < n_nodes; i++) pids[i] = start_process(i);
  while (alive > 0) {
    struct timespec pause = {0, (long)(draw(&seed) % 3000000)};
    nanosleep(&pause, NULL);
    int64_t victim = (int64_t)(draw(&seed) % (uint64_t)n_nodes);
    if (budget > 0 && pids[victim] != 0) {
      kill(pids[victim], draw(&seed) & 1 ? SIGKILL : SIGSTOP);
      nanosleep(&pause, NULL);
      kill(pids[victim], SIGCONT);
    }
    for (int64_t i = 0; i < n_nodes; i++) {
      int status;
      if (pids[i] == 0 || waitpid(pids[i], &status, WNOHANG) != pids[i]) continue;
      if (WIFSIGNALED(status) && WTERMSIG(status) != SIGKILL) abort();
      if (WIFSIGNALED(status)) {
        budget--, *kills += 1;
        pids[i] = start_process(i);
      } else {
        pids[i] = 0, alive--;
      }
    }
  }
  return is_right() && is_complete();
}

static int by_size(const void *a, const void *b) {
  double difference = *(const double *)a - *(const double *)b;
  return (difference > 0) - (difference < 0);
}

int main(int n, char **arguments) {
  if (n != 7) return 2;
  is_chain = strcmp(arguments[1], "chain") == 0;
  is_jacobi = strcmp(arguments[1], "jacobi") == 0;
  n_nodes = atoll(arguments[2]), window = atoll(arguments[3]), points = atoll(arguments[4]);
  const int64_t seconds = atoll(arguments[5]), end = now() + seconds * 1000000000;
  const char *modes[] = {"quiet", "disturbed", "forged", "killed", "streamed", "cut"};
  while (mode <= CUTTING && strcmp(arguments[6], modes[mode]) != 0) mode++;
  if (mode > CUTTING || n_nodes < 2 || n_nodes > MAX_NODES || window < 1) return 2;
  for (rows = 1; rows < window + 1; rows *= 2) continue;
  expected = malloc((size_t)((points + 1) * n_nodes) * 8);
  memory = mmap(NULL, memory_bytes(), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  if (memory == MAP_FAILED || expected == NULL) return 2;
  for (int64_t i = 0; i < n_nodes; i++)
    memories[i] = mmap(NULL, memory_bytes(), PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  compute_expected();
  int64_t runs = 0, late = 0, wrong = 0, kills = 0;
  alarm((unsigned)seconds + 120);
  do {
    int64_t begin = now();
    wrong += !(mode == KILLED ? run_processes(&kills) : mode >= STREAMED ? run_streamed(&late) : run_threads(&late));
    times[runs++] = (double)(now() - begin) / 1e3 / (double)points;
  } while (now() < end && runs < MAX_RUNS);
  qsort(times, (size_t)runs, 8, by_size);
  printf("runs %lld late %lld wrong %lld us %.3f best %.3f", (long long)runs, (long long)late, (long long)wrong,
         times[runs / 2], times[0]);
  if (mode == DISTURBED) printf(" overrun %lld pauses %lld", (long long)n_overrun, (long long)n_pauses);
  if (mode == KILLED) printf(" kills %lld", (long long)kills);
  if (mode == CUTTING) printf(" cuts %lld", (long long)n_cuts);
  if (mode == FORGING) printf(" forged %lld", (long long)n_forged);
  printf("\n");
  return (late > 0 && mode != FORGING) || wrong > 0;
}
