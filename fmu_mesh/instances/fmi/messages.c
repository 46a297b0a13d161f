/* The loggers that FMUs call: they format a message, and decide whether it is passed on or only counted.
 *
 * A kind of messages: whose they are (address and name, as the FMU gives them), status, category and format; where
 * that formats nothing (FMI 3.0, "%s", no %), the text without its numbers. The first messages of a kind are passed on;
 * then one a second, in the end one a minute, with the number of those that were only counted before it. The last ones
 * that were only counted and have a status above ok are kept, because they may say why a call fails.
 *
 * An FMU may log from any of its threads, so the tables have a lock. It is never held while Python is called: whoever
 * waits for it may hold the interpreter's lock.
 */
#define _GNU_SOURCE
#include <sched.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#define PUBLIC __attribute__((visibility("default")))

enum { IN_ALL = 1000 }; /* once so many were passed on, less of each kind is */
enum { KINDS = 256, MOST = 320, KEPT = 3, NAME = 256, TEXT = 4096, COMPARED = 200, SECOND = 1000000000 };

typedef struct { /* callbacks.py has the same structure */
  uint64_t kind;
  const void *address;
  int64_t counted; /* this one and those before it that were not passed on; 0: it is passed on itself */
  int32_t status;
  char name[NAME], category[NAME], text[TEXT];
} Message;

static struct {
  uint64_t kind;
  int64_t shown, passed_at;
} kinds[MOST]; /* apart from the messages, because every message searches it */
static Message first[MOST], kept[KEPT];
static int64_t n_kinds, n_kept, n_recalled, n_shown;
static atomic_flag locked = ATOMIC_FLAG_INIT;
static void (*pass_on)(const Message *);

static void lock(void) {
  while (atomic_flag_test_and_set_explicit(&locked, memory_order_acquire)) sched_yield();
}

static void unlock(void) { atomic_flag_clear_explicit(&locked, memory_order_release); }

static void copy(Message *to, const Message *from) {
  memcpy(to, from, offsetof(Message, text) + strlen(from->text) + 1);
}

static uint64_t mixed(uint64_t hash, const char *text, int with_numbers) {
  for (int n = 0; n < COMPARED && text[n]; n++)
    if (with_numbers || !strchr("0123456789.+-eE", text[n])) hash = (hash ^ (unsigned char)text[n]) * 0x100000001b3;
  return (hash ^ 0xff) * 0x100000001b3;
}

static int64_t place_of(uint64_t kind) {
  int64_t n = 0;
  while (n < n_kinds && kinds[n].kind != kind) n++;
  return n;
}

static void take(Message *new, const char *format, va_list *values) {
  uint64_t whose = mixed((uint64_t)(uintptr_t)new->address * 31 + (uint64_t)new->status, new->name, 1);
  int formats = values && strchr(format, '%') && strcmp(format, "%s");
  if (formats) vsnprintf(new->text, TEXT, format, *values);
  else snprintf(new->text, TEXT, "%s", values && *format == '%' ? va_arg(*values, const char *) : format);
  new->kind = mixed(mixed(whose, new->category, 1), formats ? format : new->text, formats);
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  int64_t ns = (int64_t)now.tv_sec * SECOND + now.tv_nsec;
  lock();
  int64_t n = place_of(new->kind);
  if (n >= KINDS && n == n_kinds && (n = place_of(new->kind = whose)) == MOST) n--; /* too many: without the text */
  if (n == n_kinds) {
    n_kinds++;
    kinds[n].kind = new->kind;
    kinds[n].shown = new->counted = 0;
    copy(&first[n], new);
  }
  int many = n_shown >= IN_ALL;
  int passes = kinds[n].shown < (many ? 5 : 100) || ns - kinds[n].passed_at >= (many ? 60LL : 1LL) * SECOND;
  new->counted = first[n].counted + (first[n].counted > 0 || !passes);
  first[n].counted = passes ? 0 : new->counted;
  if (passes) {
    n_shown++;
    kinds[n].shown++;
    kinds[n].passed_at = ns;
  } else if (new->status > 0) copy(&kept[n_kept++ % KEPT], new);
  unlock();
  if (passes) pass_on(new);
}

static void begin(Message *new, const void *address, const char *name, int status, const char *category) {
  new->address = address;
  new->status = status;
  snprintf(new->name, NAME, "%s", name ? name : "");
  snprintf(new->category, NAME, "%s", category ? category : "");
}

PUBLIC void log_fmi1_2(void *address, const char *name, int status, const char *category, const char *format, ...) {
  Message new;
  va_list values;
  va_start(values, format);
  begin(&new, address, name, status, category);
  take(&new, format ? format : "", &values);
  va_end(values);
}

/* A message that is formatted already: from a host under Wine (rings/hosted.c). */
void log_of_host(const void *address, const char *name, int status, const char *category, const char *text) {
  Message new;
  begin(&new, address, name, status, category);
  take(&new, text ? text : "", NULL);
}

PUBLIC void log_fmi3(void *address, int status, const char *category, const char *text) {
  log_of_host(address, NULL, status, category, text);
}

/* ---- for Python */

PUBLIC void pass_messages_to(void (*function)(const Message *)) { pass_on = function; }

/* The first message of the n-th kind, with the number of those that were counted since one was passed on. */
PUBLIC int32_t message_of_kind(int64_t n, Message *to) {
  lock();
  int32_t found = n < n_kinds;
  if (found) copy(to, &first[n]);
  unlock();
  return found;
}

/* Begin anew with the kind of a message; updates its number. */
PUBLIC void forget_kind(Message *of) {
  lock();
  int64_t n = place_of(of->kind), last = n_kinds - 1;
  of->counted = n <= last ? first[n].counted : 0;
  if (n <= last) {
    n_shown -= kinds[n].shown;
    kinds[n] = kinds[last];
    if (n < last) copy(&first[n], &first[last]);
    n_kinds--;
  }
  unlock();
}

/* The oldest message that was kept and not recalled. */
PUBLIC int32_t recall_message(Message *to) {
  lock();
  if (n_recalled < n_kept - KEPT) n_recalled = n_kept - KEPT;
  int32_t found = n_recalled < n_kept;
  if (found) copy(to, &kept[n_recalled++ % KEPT]);
  unlock();
  return found;
}
