/* An FMU for Windows, seen from the node: its functions are called by a host, a program under Wine (windows_host.c).
 *
 * The node and the host share a memory: a mailbox, messages of the FMU, and room for what a request needs. For each
 * request the node copies the tables of the step into this room, with addresses as the host has them, and afterwards
 * what the host has changed back. So Python makes and changes tables as for any other FMU, and the host runs the burst
 * of `burst.c` itself: many steps with one request. It also maps the memory of the run, and writes rows and counters as
 * a node does. A step alone (TAKE_STEP) needs no such memory: its rows are copied, too.
 *
 * Who meets here: the one thread of the node that calls the FMU, and the host, which does one request at a time. Threads
 * of the FMU may log at any time. Each side looks for a while, and then says that it sleeps, looks once more, and reads
 * from its pipe; the other side writes a byte if that is said. There is no futex under Wine: a bell that the host rings
 * is `owed`, and the node wakes who sleeps on it.
 *
 * What may go wrong: the host crashes or is killed (the pipe ends; then each call returns FATAL, and a message says
 * why), a call never returns (the step and stage are copied while the node waits, so that its watch tells them; the end
 * of the node ends the host). Tried and given up: memory at the same address in both, which Wine may refuse; and one
 * request for each function of a step (ADR 99). */
#define _GNU_SOURCE
#include <poll.h>
#include <string.h>
#include <sys/wait.h>

#include "counters.h"
#include "windows_host.h"

enum { FATAL = 4, STAGE_BITS = 24, LOOK_NS = 10000, LOOK_MS = 100, END_MS = 1000, LONG_STEPS = 16 };

/* See messages.c. */
void log_of_host(const void *address, const char *name, int status, const char *category, const char *text);

typedef struct { /* what is copied for one request */
  Host *host;
  char *next;
  int is_lost; /* whether the host does not have some memory */
  Member *member; /* of this process, and its copy */
  Member *copy;
  char **regions; /* the copies of its regions */
} Packed;

/* ---- requests */

static Mailbox *mailbox_of(const Host *host) { return (Mailbox *)(void *)host->mailbox; }

static void take_messages(Host *host) {
  Mailbox *box = mailbox_of(host);
  for (int64_t n; (n = seen(&box->taken)) < seen(&box->told); say(&box->taken, n + 1)) {
    const HostMessage *message = message_of(box, n);
    log_of_host((const void *)message->address, message->name, (int)message->status, message->category, message->text);
  }
}

static void wake_owed(const Place *place) {
  for (int64_t i = 0; place != NULL && i < place->processes; i++) {
    Bell *bell = &place->bells[i];
    if (atomic_load_explicit(&bell->owed, memory_order_relaxed) &&
        atomic_exchange_explicit(&bell->owed, 0, memory_order_seq_cst))
      wake_bell(bell);
  }
}

static void *back(const Host *host, const void *address) {
  return host->mailbox + ((int64_t)address - mailbox_of(host)->there);
}

/* What others ask about while a request lasts: where the member is. */
static void show(const Packed *packed) {
  if (packed == NULL) return;
  Member *member = packed->member;
  member->step = packed->copy->step;
  member->stage = packed->copy->stage;
  member->said->step = ((const Said *)back(packed->host, packed->copy->said))->step;
}

/* How a host has ended that has closed its pipe, as the end of a sentence. */
static void note_end(const Host *host, char *text, size_t size) {
  const int process = (int)syscall(SYS_pidfd_open, (pid_t)host->process, 0);
  struct pollfd end = {.fd = process, .events = POLLIN};
  siginfo_t how = {0};
  if (process >= 0) {
    poll(&end, 1, END_MS);
    waitid(P_PID, (id_t)host->process, &how, WEXITED | WNOHANG | WNOWAIT);
    close(process);
  }
  if (how.si_pid != 0 && how.si_code == CLD_EXITED)
    snprintf(text, size, "has ended with exit code %d", how.si_status);
  else if (how.si_pid != 0)
    snprintf(text, size, "was ended by signal %d", how.si_status);
  else
    snprintf(text, size, "has ended");
}

static void end_host(Host *host) {
  Mailbox *box = mailbox_of(host);
  char text[700];
  take_messages(host);
  host->ended = 1;
  if (box->crash)
    snprintf(text, sizeof text, "the FMU has crashed under Wine: exception 0x%08llX%s at 0x%llx%s%.500s",
             (unsigned long long)box->crash, box->crash == 0xC0000005 ? " (access violation)" : "",
             (unsigned long long)box->crash_address, box->text[0] ? " of " : "", box->text);
  else
    note_end(host, text + snprintf(text, sizeof text, "the process of the FMU under Wine "), 100);
  log_of_host(NULL, host->name, FATAL, "wine", text);
}

/* Let the host do what the mailbox says. Whether it is done; otherwise the host has ended. */
static int ask(Host *host, const Place *place, const Packed *packed) {
  if (host->ended) return 0;
  Mailbox *box = mailbox_of(host);
  const int64_t number = seen(&box->asked) + 1, end = now() + LOOK_NS;
  char bytes[64];
  say(&box->asked, number);
  if (take_back(&box->host_sleeps)) {
    const ssize_t written = write((int)host->to, "", 1); /* where the host has ended, its other pipe ends, too */
    (void)written;
  }
  for (int i = 0; seen(&box->done) < number; i++) {
    if (i < 100 || now() < end) {
      relax();
    } else {
      say(&box->node_sleeps, 1);
      wake_owed(place);
      show(packed);
      take_messages(host);
      struct pollfd pipe = {.fd = (int)host->from, .events = POLLIN};
      if (seen(&box->done) < number && poll(&pipe, 1, LOOK_MS) > 0 && read(pipe.fd, bytes, sizeof bytes) == 0 &&
          seen(&box->done) < number) {
        end_host(host);
        break;
      }
    }
  }
  say(&box->node_sleeps, 0);
  wake_owed(place);
  show(packed);
  take_messages(host);
  return !host->ended;
}

/* For Python: as `ask`. */
PUBLIC int64_t host_ask(Host *host) { return ask(host, NULL, NULL); }

/* ---- tables */

static void *there(Packed *packed, const void *address) {
  const Host *host = packed->host;
  const char *own = address;
  if (own == NULL) return NULL;
  if (own >= host->mailbox && own < host->mailbox + host->size)
    return (void *)(uintptr_t)(mailbox_of(host)->there + (own - host->mailbox));
  if (own >= host->shared && own < host->shared + host->shared_size)
    return (void *)(uintptr_t)(host->shared_there + (own - host->shared));
  packed->is_lost = 1;
  return NULL;
}

static Counter *here(const Host *host, const Counter *address) {
  const char *own = (const char *)address;
  return own == NULL ? NULL : (Counter *)(void *)(host->shared + (own - host->shared_there));
}

/* Copy memory; returns where this process has the copy. */
static void *put(Packed *packed, const void *from, int64_t size) {
  char *to = packed->next;
  packed->next += (size + 63) / 64 * 64;
  if (packed->next > packed->host->mailbox + packed->host->size) {
    packed->is_lost = 1;
    return packed->next = packed->host->mailbox + ROOM;
  }
  if (from != NULL && size > 0) memcpy(to, from, (size_t)size);
  return to;
}

/* Where the host has memory of a region. */
static void *in_region(Packed *packed, const void *address) {
  const Member *member = packed->member;
  const char *own = address;
  for (int64_t i = 0; i < member->n_regions; i++) {
    const Region *region = &member->regions[i];
    if (own >= region->address && own < region->address + region->size)
      return there(packed, packed->regions[i] + (own - region->address));
  }
  return there(packed, address);
}

static void *function_of(Packed *packed, const void *function) {
  const Host *host = packed->host;
  for (int64_t i = 0; i < host->n_functions; i++)
    if (host->functions[i].here == function) return host->functions[i].there;
  packed->is_lost = 1;
  return NULL;
}

static Move *put_moves(Packed *packed, const Move *moves, int64_t n) {
  Move *copies = put(packed, moves, n * (int64_t)sizeof *moves);
  for (int64_t i = 0; i < n; i++) {
    Move *copy = &copies[i];
    if (copy->from_base == FIXED) copy->from = (int64_t)in_region(packed, (void *)copy->from);
    if (copy->to_base == FIXED) copy->to = (int64_t)in_region(packed, (void *)copy->to);
    if (copy->lookup == NULL) continue;
    Lookup *lookup = put(packed, copy->lookup, sizeof *lookup);
    lookup->entries = there(packed, put(packed, lookup->entries, lookup->n_entries * (int64_t)sizeof(Entry)));
    lookup->items = there(packed, put(packed, lookup->items, lookup->n_items * (int64_t)sizeof(int64_t)));
    copy->lookup = there(packed, lookup);
  }
  return there(packed, copies);
}

static Call *put_calls(Packed *packed, const Call *calls, int64_t n) {
  Call *copies = put(packed, calls, n * (int64_t)sizeof *calls);
  for (int64_t i = 0; i < n; i++) {
    copies[i].function = function_of(packed, copies[i].function);
    copies[i].references = in_region(packed, copies[i].references);
    if (copies[i].base == FIXED) copies[i].values = (int64_t)in_region(packed, (void *)copies[i].values);
  }
  return there(packed, copies);
}

/* Copy a member, and what each step of it needs. */
static void put_member(Packed *packed, Host *host, Member *member) {
  *packed = (Packed){.host = host, .next = host->mailbox + ROOM, .member = member};
  Member *copy = packed->copy = put(packed, member, sizeof *member);
  packed->regions = put(packed, NULL, member->n_regions * (int64_t)sizeof(char *));
  for (int64_t i = 0; i < member->n_regions; i++)
    packed->regions[i] = put(packed, member->regions[i].address, member->regions[i].size);
  copy->host = NULL;
  copy->do_step = function_of(packed, member->do_step);
  copy->said = there(packed, put(packed, member->said, sizeof *member->said));
  copy->setters = put_calls(packed, member->setters, member->n_setters);
  copy->getters = put_calls(packed, member->getters, member->n_getters);
  copy->stores = put_moves(packed, member->stores, member->n_stores);
  copy->bases = put(packed, member->bases, (FIRST_GATE + member->n_gates) * (int64_t)sizeof(char *));
  copy->bases = there(packed, copy->bases);
  copy->n_tracks = 0;
}

/* Take back what the host has changed. */
static void take_member(Packed *packed, Member *member) {
  const Member *copy = packed->copy;
  for (int64_t i = 0; i < member->n_regions; i++)
    memcpy(member->regions[i].address, packed->regions[i], (size_t)member->regions[i].size);
  memcpy(member->said, back(packed->host, copy->said), sizeof *member->said);
  member->step = copy->step;
  member->stage = copy->stage;
  member->outcome = copy->outcome;
}

static int64_t request(Packed *packed, int64_t what, void *first, int64_t second, const Place *place) {
  Mailbox *box = mailbox_of(packed->host);
  box->what = what;
  box->arguments[0] = (int64_t)there(packed, first);
  box->arguments[1] = second;
  return ask(packed->host, place, packed) ? box->result : -1;
}

int64_t hosted_step(Member *member, int64_t step) {
  Packed packed;
  char *rows[2];
  put_member(&packed, member->host, member);
  Member *copy = packed.copy;
  copy->n_feeds = copy->n_loads = copy->lines_count = copy->n_gates = copy->n_finite = 0;
  for (int i = 0; i < 2; i++) {
    const Output *output = &member->outputs[i];
    const int is_same = i == 1 && output->rows == member->outputs[0].rows;
    rows[i] = is_same ? rows[0] : put(&packed, output->rows + ((step + 1) & output->mask) * output->stride, output->stride);
    copy->outputs[i] = (Output){there(&packed, rows[i]), output->stride, 0};
  }
  copy->step = member->step;
  const int64_t outcome = packed.is_lost ? -1 : request(&packed, TAKE_STEP, copy, step, NULL);
  if (outcome < 0) {
    if (!packed.is_lost) show(&packed);
    return (int64_t)(member->stage < STEPPING ? STEPPING : member->stage) << STAGE_BITS | FATAL;
  }
  take_member(&packed, member);
  for (int i = 0; i < 2; i++) {
    const Output *output = &member->outputs[i];
    if (i == 0 || rows[1] != rows[0])
      memcpy(output->rows + ((step + 1) & output->mask) * output->stride, rows[i], (size_t)output->stride);
  }
  return outcome;
}

/* Copy the gates of a member, and whatever else only a burst needs. */
static void put_burst(Packed *packed, const Member *member) {
  Member *copy = packed->copy;
  copy->feeds = put_moves(packed, member->feeds, member->n_feeds);
  copy->loads = put_moves(packed, member->loads, member->n_loads);
  copy->finite = there(packed, put(packed, member->finite, member->n_finite * (int64_t)sizeof(Span)));
  Line *lines = put(packed, member->lines, member->lines_count * (int64_t)sizeof(Line));
  for (int64_t i = 0; i < member->lines_count; i++) lines[i].to = in_region(packed, lines[i].to);
  copy->lines = there(packed, lines);
  for (int i = 0; i < 2; i++) copy->outputs[i].rows = there(packed, member->outputs[i].rows);
  copy->counter = there(packed, member->counter);
  Gate *gates = put(packed, member->gates, member->n_gates * (int64_t)sizeof(Gate));
  for (int64_t i = 0; i < member->n_gates; i++) {
    gates[i].counter = there(packed, gates[i].counter);
    gates[i].rows = there(packed, gates[i].rows);
  }
  copy->gates = there(packed, gates);
}

int hosted_advance(Node *node, Unit *unit, int64_t *ticks) {
  Packed packed;
  Member *member = unit->members;
  Host *host = member->host;
  if (member->n_tracks > 0 || host->ended) return NOT_HOSTED;
  if (node->streams != NULL && unit->burst <= LONG_STEPS) streams_write(node->streams, 0);
  put_member(&packed, host, member);
  put_burst(&packed, member);
  Node *node_copy = put(&packed, node, sizeof *node);
  Unit *unit_copy = put(&packed, unit, sizeof *unit);
  Peer *peers = put(&packed, node->peers, node->n_peers * (int64_t)sizeof(Peer));
  for (int64_t i = 0; i < node->n_peers; i++) peers[i].progress = there(&packed, peers[i].progress);
  unit_copy->members = there(&packed, packed.copy);
  unit_copy->blocked_by = NULL;
  if (node->streams != NULL && unit->burst <= LONG_STEPS) unit_copy->burst = 1;
  node_copy->place.bells = there(&packed, node->place.bells);
  node_copy->streams = NULL;
  node_copy->units = there(&packed, unit_copy);
  node_copy->peers = there(&packed, peers);
  node_copy->ceiling = there(&packed, node->ceiling);
  node_copy->finish = NULL;
  node_copy->progress = there(&packed, node->progress);
  if (packed.is_lost) return NOT_HOSTED;
  const int64_t first = unit->tick;
  int result = (int)request(&packed, TAKE_BURST, node_copy, 0, &node->place);
  take_member(&packed, member);
  const Gate *gates = back(host, packed.copy->gates);
  for (int64_t i = 0; i < member->n_gates; i++) member->gates[i].known = gates[i].known;
  const Line *lines = back(host, packed.copy->lines);
  for (int64_t i = 0; i < member->lines_count; i++) {
    double *const to = member->lines[i].to;
    member->lines[i] = lines[i];
    member->lines[i].to = to;
  }
  unit->tick = unit_copy->tick;
  unit->next = unit_copy->next;
  if (unit_copy->blocked_by != NULL) {
    unit->blocked_by = here(host, unit_copy->blocked_by);
    unit->need = unit_copy->need;
  }
  node->allowed = node_copy->allowed;
  node->stride = node_copy->stride;
  node->patience = node_copy->patience;
  node->restored = node_copy->restored;
  node->unit = unit - node->units;
  node->member = unit->next;
  *ticks = unit->tick - first;
  if (result >= 0) return result;
  member->outcome = (int64_t)(member->stage < STEPPING ? STEPPING : member->stage) << STAGE_BITS | FATAL;
  return STATUS;
}
