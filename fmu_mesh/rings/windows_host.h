/* The memory that a node and the host of an FMU share: the mailbox of burst.h, messages of the FMU, and room. */
#ifndef FMU_MESH_WINDOWS_HOST_H
#define FMU_MESH_WINDOWS_HOST_H

#include <stdatomic.h>

#include "burst.h"

enum { MESSAGES = 16, MESSAGES_AT = 4096, ROOM = 131072 };

typedef struct { /* one message of the FMU, formatted */
  int64_t address, status;
  char name[256], category[256], text[4096];
} HostMessage;

static inline HostMessage *message_of(Mailbox *box, int64_t n) {
  return (HostMessage *)(void *)((char *)box + MESSAGES_AT) + n % MESSAGES;
}

/* Numbers of the mailbox. All seq_cst: each side says that it sleeps, and then looks once more. */
static inline int64_t seen(const _Atomic int64_t *number) { return atomic_load_explicit(number, memory_order_seq_cst); }

static inline void say(_Atomic int64_t *number, int64_t value) {
  atomic_store_explicit(number, value, memory_order_seq_cst);
}

static inline int64_t take_back(_Atomic int64_t *number) {
  return atomic_exchange_explicit(number, 0, memory_order_seq_cst);
}

_Static_assert(sizeof(Mailbox) <= MESSAGES_AT && MESSAGES_AT + MESSAGES * sizeof(HostMessage) <= ROOM, "they overlap");

#endif
