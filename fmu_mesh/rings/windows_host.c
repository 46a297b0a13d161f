/* The program that runs one FMU for Windows, under Wine: it loads the library, and does what its node asks for.
 *
 *   burst-windows-x86_64.exe MEMORY
 *
 * MEMORY is a path of the memory that the node shares; hosted.c says how. The program ends when its standard input does,
 * so with its node. The thread of `main` calls the FMU, and no other one; threads of the FMU may log. */
#include <fcntl.h>
#include <fenv.h>
#include <io.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#define NOGDI /* it has names of ours */
#define WIN32_LEAN_AND_MEAN
#include <windows.h>

#include "windows_host.h"

enum { LOOK_TICKS = 100 /* of 100 ns */, MOST_ARGUMENTS = 15, MESSAGE_MS = 1000 };

int64_t take_step(Member *member, int64_t step);
int64_t take_burst(Node *node, int64_t *ticks);

static Mailbox *box;
static HANDLE from_node, to_node;
static HMODULE library;
static atomic_flag logging = ATOMIC_FLAG_INIT;

/* Let the node look, if it sleeps. */
void nudge(void) {
  DWORD written;
  if (take_back(&box->node_sleeps)) WriteFile(to_node, "", 1, &written, NULL);
}

/* ---- what burst.c and counters.h call in a node, and never here: the tables have no streams, and nothing sleeps */

int streams_read(Streams *streams) { return streams == NULL; }

void streams_write(Streams *streams, int64_t all) { (void)streams, (void)all; }

int64_t sleep_on(const Place *place, Streams *streams, uint32_t seen, const Wish *wishes, int64_t n, int64_t limit_ns,
                 int64_t *late) {
  (void)place, (void)streams, (void)seen, (void)wishes, (void)n, (void)limit_ns, (void)late;
  return 0;
}

int64_t hosted_step(Member *member, int64_t step) { return (void)member, step; }

int hosted_advance(Node *node, Unit *unit, int64_t *ticks) { return (void)node, (void)unit, (void)ticks, -1; }

/* ---- callbacks */

static void add_message(const void *address, const char *name, int status, const char *category, const char *format,
                        va_list *values) {
  const DWORD start = GetTickCount();
  while (atomic_flag_test_and_set_explicit(&logging, memory_order_acquire)) SwitchToThread();
  const int64_t n = seen(&box->told);
  while (n - seen(&box->taken) >= MESSAGES && GetTickCount() - start < MESSAGE_MS) {
    nudge();
    SwitchToThread(); /* only where a thread of the FMU logs between two requests, the node does not take any */
  }
  if (n - seen(&box->taken) < MESSAGES) {
    HostMessage *message = message_of(box, n);
    message->address = (int64_t)address;
    message->status = status;
    snprintf(message->name, sizeof message->name, "%s", name ? name : "");
    snprintf(message->category, sizeof message->category, "%s", category ? category : "");
    if (values != NULL)
      vsnprintf(message->text, sizeof message->text, format ? format : "", *values);
    else
      snprintf(message->text, sizeof message->text, "%s", format ? format : "");
    say(&box->told, n + 1);
  }
  atomic_flag_clear_explicit(&logging, memory_order_release);
}

static void log_fmi1_2(void *address, const char *name, int status, const char *category, const char *format, ...) {
  va_list values;
  va_start(values, format);
  add_message(address, name, status, category, format, &values);
  va_end(values);
}

static void log_fmi3(void *address, int status, const char *category, const char *text) {
  add_message(address, NULL, status, category, text, NULL);
}

typedef struct { /* of FMI 1.0 and 2.0; the last one of FMI 2.0 only */
  void (*log)(void *, const char *, int, const char *, const char *, ...);
  void *(*allocate)(size_t, size_t);
  void (*free)(void *);
  void *step_finished, *environment;
} Callbacks;

static Callbacks callbacks_fmi1 = {log_fmi1_2, calloc, free, NULL, NULL};

static int64_t made_callbacks(void *environment) {
  Callbacks *made = malloc(sizeof *made); /* an FMU keeps the address, so it stays as long as this program */
  if (made == NULL) return 0;
  *made = callbacks_fmi1;
  made->environment = environment;
  return (int64_t)made;
}

/* ---- requests */

/* A path of the mailbox's memory, as Windows wants it. */
static wchar_t *wide(int64_t offset) {
  static wchar_t text[4096];
  return MultiByteToWideChar(CP_UTF8, 0, (char *)box + offset, -1, text, 4096) > 0 ? text : NULL;
}

/* Note the names of the libraries that one needs and that cannot be loaded. */
static void note_missing(const wchar_t *path, int depth) {
  HMODULE image = LoadLibraryExW(path, NULL, DONT_RESOLVE_DLL_REFERENCES | LOAD_WITH_ALTERED_SEARCH_PATH);
  if (image == NULL || depth > 8) return;
  const char *base = (const char *)image;
  const IMAGE_NT_HEADERS64 *headers = (const void *)(base + ((const IMAGE_DOS_HEADER *)image)->e_lfanew);
  const IMAGE_DATA_DIRECTORY *imports = &headers->OptionalHeader.DataDirectory[IMAGE_DIRECTORY_ENTRY_IMPORT];
  const IMAGE_IMPORT_DESCRIPTOR *one = (const void *)(base + imports->VirtualAddress);
  for (; imports->Size > 0 && one->Name != 0; one++) {
    const char *name = base + one->Name;
    wchar_t needed[MAX_PATH];
    if (LoadLibraryA(name) != NULL || MultiByteToWideChar(CP_UTF8, 0, name, -1, needed, MAX_PATH) == 0) continue;
    HMODULE there = LoadLibraryExW(needed, NULL, DONT_RESOLVE_DLL_REFERENCES);
    if (there != NULL) {
      note_missing(needed, depth + 1);
    } else if (strstr(box->text, name) == NULL) {
      const size_t length = strlen(box->text);
      snprintf(box->text + length, sizeof box->text - length, "%s%s", length ? ", " : "", name);
    }
  }
}

static int64_t load(int64_t path, int64_t folder) {
  SetDllDirectoryW(wide(folder));
  box->text[0] = 0;
  library = LoadLibraryExW(wide(path), NULL, LOAD_WITH_ALTERED_SEARCH_PATH);
  box->result = GetLastError();
  if (library == NULL && box->result == ERROR_MOD_NOT_FOUND) note_missing(wide(path), 0);
  return library != NULL;
}

/* Map a file of Linux; 0 if that cannot be. */
static void *mapped(const wchar_t *path) {
  const DWORD shared = FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE;
  HANDLE file = CreateFileW(path, GENERIC_READ | GENERIC_WRITE, shared, NULL, OPEN_EXISTING, 0, NULL);
  HANDLE mapping = file == INVALID_HANDLE_VALUE ? NULL : CreateFileMappingW(file, NULL, PAGE_READWRITE, 0, 0, NULL);
  return mapping == NULL ? NULL : MapViewOfFile(mapping, FILE_MAP_ALL_ACCESS, 0, 0, 0);
}

/* Copy texts that an FMU has returned, one after another with a zero; with sizes, bytes. Returns how long all are. */
static int64_t copy_texts(char *const *from, int64_t n, const size_t *sizes, char *to, int64_t room) {
  int64_t used = 0;
  for (int64_t i = 0; i < n; i++) {
    const int64_t size = sizes != NULL ? (int64_t)sizes[i] : from[i] != NULL ? (int64_t)strlen(from[i]) : 0;
    if (used + size + 1 <= room) {
      if (from[i] != NULL) memcpy(to + used, from[i], (size_t)size);
      to[used + size] = 0;
    }
    used += size + 1;
  }
  return used;
}

/* Call a function with arguments of 64 bits each. Of a function with "...", a number is in a register for integers and in
 * one for floats; so it is where the function looks for it, whatever its type. */
static int64_t call(const int64_t *arguments) {
  double a[MOST_ARGUMENTS];
  memcpy(a, arguments + 1, sizeof a);
  return ((int64_t (*)(double, ...))arguments[0])(a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], a[10], a[11],
                                                  a[12], a[13], a[14]);
}

static int64_t answer(void) {
  const int64_t *a = box->arguments;
  int64_t ticks;
  switch (box->what) {
    case CALL_FUNCTION: return call(a);
    case LOAD: return load(a[0], a[1]) ? 0 : box->result;
    case FIND: return (int64_t)GetProcAddress(library, (char *)box + a[0]);
    case MAP: return (int64_t)mapped(wide(a[0]));
    case MAKE_CALLBACKS: return made_callbacks((void *)a[0]);
    case COPY_TEXTS: return copy_texts((char *const *)a[0], a[1], (const size_t *)a[2], (char *)a[3], a[4]);
    case TAKE_STEP: return take_step((Member *)a[0], a[1]);
    default: return take_burst((Node *)a[0], &ticks);
  }
}

static void await_request(int64_t number) {
  LARGE_INTEGER begin, now;
  char byte;
  DWORD got;
  QueryPerformanceCounter(&begin);
  while (seen(&box->asked) < number) {
    __builtin_ia32_pause();
    QueryPerformanceCounter(&now);
    if (now.QuadPart - begin.QuadPart < LOOK_TICKS) continue;
    say(&box->host_sleeps, 1);
    if (seen(&box->asked) >= number) break;
    if (!ReadFile(from_node, &byte, 1, &got, NULL) || got == 0) TerminateProcess(GetCurrentProcess(), 0); /* the node has ended */
  }
  say(&box->host_sleeps, 0);
}

/* Note where an exception was that nothing handles, and end. */
static LONG WINAPI crashed(EXCEPTION_POINTERS *pointers) {
  const EXCEPTION_RECORD *record = pointers->ExceptionRecord;
  HMODULE module = NULL;
  char path[MAX_PATH] = "";
  GetModuleHandleExA(GET_MODULE_HANDLE_EX_FLAG_FROM_ADDRESS | GET_MODULE_HANDLE_EX_FLAG_UNCHANGED_REFCOUNT,
                     (const char *)record->ExceptionAddress, &module);
  if (module != NULL) GetModuleFileNameA(module, path, sizeof path);
  const char *name = strrchr(path, '\\');
  snprintf(box->text, sizeof box->text, "%s", name ? name + 1 : path);
  box->crash_address = (int64_t)record->ExceptionAddress - (int64_t)module;
  box->crash = (int64_t)record->ExceptionCode;
  TerminateProcess(GetCurrentProcess(), 1);
  return EXCEPTION_EXECUTE_HANDLER;
}

/* What the FMU prints goes where the node's standard error does; it can read nothing. */
static int take_pipes(void) {
  HANDLE own = GetCurrentProcess();
  const HANDLE in = GetStdHandle(STD_INPUT_HANDLE), out = GetStdHandle(STD_OUTPUT_HANDLE);
  const int nothing = _open("NUL", _O_RDONLY);
  return DuplicateHandle(own, in, own, &from_node, 0, FALSE, DUPLICATE_SAME_ACCESS) &&
         DuplicateHandle(own, out, own, &to_node, 0, FALSE, DUPLICATE_SAME_ACCESS) && _dup2(2, 1) == 0 &&
         _dup2(nothing, 0) == 0;
}

int main(int count, char **values) {
  static wchar_t path[512];
  if (count != 2 || MultiByteToWideChar(CP_UTF8, 0, values[1], -1, path, 512) == 0) return 2;
  if ((box = mapped(path)) == NULL || !take_pipes()) return 3;
  SetErrorMode(SEM_FAILCRITICALERRORS | SEM_NOGPFAULTERRORBOX | SEM_NOOPENFILEERRORBOX);
  SetUnhandledExceptionFilter(crashed);
  box->there = (int64_t)box;
  box->log_fmi3 = (int64_t)log_fmi3;
  box->callbacks_fmi1 = (int64_t)&callbacks_fmi1;
  for (int64_t number = 1;; number++) {
    await_request(number);
    box->result = answer();
    fesetenv(FE_DFL_ENV); /* the FMU may have changed it */
    say(&box->done, number);
    nudge();
  }
}
