/* The tables of the burst: this is the only list of their fields. `burst.c` includes it, and `native.py` reads it with
 * expressions of a few lines, because a parser of C takes 40 ms at each start of a process. So it is written plainly: each
 * structure as `typedef struct { ... } Name;` with one statement for each type, and no macros. An array `things` has its
 * length beside it, `n_things`; any other pointer is only an address for Python. */
#ifndef FMU_MESH_BURST_H
#define FMU_MESH_BURST_H

#include <stdint.h>

/* ---- shared memory: `burst.c` has what is in it, for Python these are addresses */

typedef struct Counter Counter;
typedef struct Bell Bell;

typedef struct { /* which process this is among those of the memory */
  Bell *bells;
  int64_t processes, own;
} Place;

typedef struct { /* one value that somebody waits for */
  Counter *counter;
  int64_t need;
} Wish;

/* ---- an FMU for Windows, which runs under Wine: see hosted.c */

typedef struct { /* memory of this process that the tables name by addresses, and that the host needs, too */
  char *address;
  int64_t size;
} Region;

typedef struct { /* a function of the FMU: what stands in the tables of this process, and where the host has it */
  void *here, *there;
} Twin;

typedef struct { /* the first bytes of the memory that a node and the host share; then come messages, and then room */
  _Atomic int64_t asked; /* requests; only the node writes it */
  int64_t beside_asked[7];
  _Atomic int64_t done; /* how many of them are done; only the host writes it */
  int64_t beside_done[7];
  _Atomic int64_t host_sleeps, node_sleeps; /* until a byte comes through its pipe */
  _Atomic int64_t told, taken;              /* messages of the FMU: written by the host, and read by the node */
  int64_t what, result;                     /* of the request */
  int64_t arguments[16];
  int64_t there;                     /* where the host has this memory */
  int64_t log_fmi3, callbacks_fmi1;  /* addresses in the host that an FMU gets */
  int64_t crash, crash_address;      /* the exception of Windows that has ended the host */
  char text[512];                    /* what is wrong, or in which module the crash was */
} Mailbox;

typedef struct { /* the host of one FMU, for the node */
  char *mailbox;
  int64_t size;     /* of the memory that begins with it */
  int64_t to, from; /* the ends of the pipes */
  int64_t process;  /* its number */
  char *shared, *shared_there; /* the memory of the run, if the host has it, too */
  int64_t shared_size;
  Twin *functions;
  int64_t n_functions;
  const char *name; /* of the instance: the last message of a host says why it has ended */
  int64_t ended;
} Host;

enum Request { CALL_FUNCTION, LOAD, FIND, MAP, MAKE_CALLBACKS, COPY_TEXTS, TAKE_STEP, TAKE_BURST }; /* Mailbox.what */

/* ---- one instance */

enum StepKind { BY_PYTHON, FMI1, FMI2, FMI3, EQUATIONS };                  /* Member.kind */
enum Stage { WAITING, SETTING, STEPPING, GETTING, IN_PYTHON, STEPPED };    /* Member.stage */
enum RowBase { FIXED, OUTPUT, WATCHED, FIRST_GATE };                       /* what an offset is relative to: see Move */
enum Change { UNCHANGED, SCALED, LOOKED_UP, ADDED };                       /* Move.change */
enum NumberType { F64, F32, I8, U8, I16, U16, I32, U32, I64, U64, TRUTH }; /* Move.from_type, Move.to_type, Span.type */

typedef struct { /* the rows of one source, for one rule */
  Counter *counter;
  const char *rows;
  int64_t stride, mask;
  int64_t lead;   /* see system/coupling_rule.py */
  int64_t points; /* base points per step of the source */
  int64_t last;   /* its last row */
  int64_t known;  /* the counter when it was last read */
} Gate;

typedef struct { /* a value of the source, and what the target gets instead; large: see as_integer */
  int64_t from, to;
  int32_t from_large, to_large;
} Entry;

typedef struct { /* the map of a connection, and the items of its input; both in ascending order */
  const Entry *entries;
  const int64_t *items;
  int64_t n_entries, n_items; /* without items: the input can be each number of its type */
} Lookup;

typedef struct { /* values that are copied; of FIXED, an offset is an address */
  int64_t from_base, from, to_base, to;
  int64_t count;
  int32_t from_type, to_type, change;
  int32_t negated; /* an alias of FMI 1.0 with the opposite sign */
  double factor, offset;
  const Lookup *lookup;
} Move;

typedef struct { /* a getter or a setter */
  void *function;
  const void *references;
  int64_t count;
  int64_t base, values;
  int64_t size; /* number of values for FMI 3.0; otherwise -1 */
} Call;

typedef struct { /* a ring that a member writes */
  char *rows;
  int64_t stride, mask;
} Output;

typedef struct { /* floats of a row that have to be finite */
  int64_t place; /* in the row, in bytes */
  int64_t count;
  int64_t type; /* F64 or F32 */
} Span;

typedef struct { /* what a model says in a step besides its status, and how far it is: Python looks at it between steps */
  uint8_t event_needed, terminate, early; /* FMI 3.0, 4.2.1: not 0 if it is so */
  int32_t call;       /* the getter or setter that returned a status above warning */
  double last_time;   /* of an early return (FMI 3.0), in s */
  double quiet_until; /* a step that ends at this time or later is taken by Python */
  double time;        /* of the model; only after a step without anything special */
  int64_t step;       /* own steps done */
} Said;

typedef struct { /* an input with a value for each own step that the burst takes before python_at */
  const double *values;
  double *to; /* in the row of inputs */
} Track;

typedef struct { /* an input that gets the middle of the line of its source: see `SourceLine` in system/coupling_rule.py */
  double *to; /* in the row of inputs, where its value is */
  int64_t lead, source_points, last; /* as in Gate */
  double value, change;
  int64_t point, distance, jumped;
} Line;

typedef struct { /* one instance: how it gets its inputs, steps, and gives its outputs */
  Gate *gates;
  Move *feeds;  /* from the rows of the sources into the row of inputs */
  Move *loads;  /* from there into buffers */
  Call *setters;
  Call *getters;
  Move *stores; /* from buffers into the own row */
  int64_t n_gates, n_feeds, n_loads, n_setters, n_getters, n_stores;
  int64_t kind;
  void *component, *do_step; /* of EQUATIONS, `do_step` is their table */
  Said *said; /* of an FMU */
  double start_time, base_step_size, step_size;
  int64_t points; /* base points per own step */
  int64_t every;  /* ticks of the unit per own step */
  int64_t wait;   /* ticks from the first one of an own step to that in which it is taken; see steps_ahead */
  int64_t last_step;
  int64_t python_at; /* the first own step that Python takes, whatever its kind */
  Track *tracks;
  int64_t n_tracks;
  int64_t tracks_from; /* the own step of their first values */
  Line *lines; /* an array that Python has, too */
  int64_t lines_count;
  Span *finite;
  int64_t n_finite;
  Output outputs[2]; /* the own ring; and outputs that somebody watches */
  Counter *counter;  /* rows of the own ring */
  char **bases;      /* room for the rows of the gates */
  int64_t step, stage;
  int64_t outcome;   /* stage and status of a call that Python has to look at */
  void *by_python;   /* an object of Python, which is called with the number of an own step that Python takes */
  Host *host;        /* of an FMU for Windows; otherwise NULL */
  Region *regions;
  int64_t n_regions;
} Member;

/* ---- model exchange: see model_exchange.c */

enum Solved { AT_STOP, AT_EVENT, FAILED, TOO_SMALL, NOT_A_NUMBER, UNSETTLED, ENDS, GO_ON, TOO_STIFF, LEFT }; /* Equations.result */

typedef struct { /* the equations of an FMU for model exchange, and their solver */
  int64_t kind;
  void *component;
  void *set_time, *set_states, *get_states, *get_nominals, *get_derivatives, *get_indicators, *completed_step;
  void *enter_event_mode, *update_discrete_states, *enter_continuous_time_mode; /* FMI 1.0 has no modes */
  const Call *line; /* sets the inputs that change within a step; NULL: there are none */
  const double *line_values, *line_slopes; /* at `line_start`, and in 1/s */
  double line_start;
  int64_t n_states, n_indicators;
  double *states, *indicators; /* where the model is; `indicators`: before the next step */
  double *weights;             /* absolute tolerances */
  double *slopes;              /* of the seven stages, one after another */
  double *ends, *stage, *sixth; /* the states at the end of a step, of a stage, and of the sixth stage */
  double *first_indicators, *last_indicators, *next_indicators; /* at the ends of an interval, and within it */
  double tolerance, longest;    /* relative; longest step in s */
  double time, next_event;
  double step_size;             /* of the next step in s; 0: not known yet */
  int64_t is_new;               /* whether the model was changed, so that the slope of the first stage is not known */
  int64_t tells;                /* whether the FMU learns of completed steps */
  int64_t asks_event, asks_end; /* what it has said then */
  int64_t status, function, call; /* of a call that has failed: its place among those above, and of a setter */
  int64_t steps, rejected;
  int64_t stiff, not_stiff; /* steps in a row that were so; see `count_stiff` */
  int64_t doubted;          /* whether the user knows that the model is stiff */
  int64_t leaves;           /* whether another solver takes over a model that is stiff */
  const Call *setters;      /* of held inputs, which are values in a row */
  int64_t n_setters;
  const char *row; /* the inputs of the step, and those that the model has */
  char *held;
  int64_t row_bytes, is_held;
  int64_t result, terminated; /* terminated: the FMU has asked to end the simulation */
  double event_time;          /* of the last event that the library has handled */
  void *vector_data;          /* N_VGetArrayPointer of SUNDIALS, where CVode is the solver */
} Equations;

int equations_step(Equations *own, double end);

/* ---- streams: see streams.c */

enum StreamState { OPEN, CUT, GAP, TWICE, LATE, REFUSED }; /* Stream.state */
enum Last { GOES_ON, UNSAID, SAID };                       /* Outgoing.last: whether more rows come */

typedef struct { /* bytes of a row that go over the wire */
  int64_t place, size;
  int64_t truths; /* whether they are Booleans */
} Piece;

typedef struct { /* the rows of one link for the other process */
  int64_t link;
  Counter *counter;
  const char *rows;
  int64_t stride, mask;
  Piece *pieces;
  int64_t n_pieces;
  int64_t row_bytes; /* of all pieces */
  _Atomic int64_t sent; /* rows that are on their way */
  int64_t lazy;      /* they may wait for a while: nobody steps with them */
  _Atomic int64_t last;
} Outgoing;

typedef struct { /* the rows of one link from the other process */
  int64_t link;
  Counter *counter;
  char *rows;
  int64_t stride, mask;
  Piece *pieces;
  int64_t n_pieces;
  int64_t row_bytes;
  int64_t most;  /* rows of the whole run */
  int64_t ended; /* no more come */
} Incoming;

typedef struct { /* a counter of this process that the other one has, too */
  int64_t kind, number; /* of its frames: GRANT or PROGRESS, and of which process */
  Counter *counter;
  _Atomic int64_t sent;
  int64_t stride; /* by how much it grows before it is sent; 0: it may wait with all that is lazy */
} Told;

typedef struct { /* a counter of the other process */
  int64_t kind, number;
  Counter *counter;
  int64_t most;
} Heard;

typedef struct { /* one socket to another process */
  int64_t fd;
  Outgoing *outgoing;
  Incoming *incoming;
  Told *told;
  Heard *heard;
  int64_t n_outgoing, n_incoming, n_told, n_heard;
  char *to_send, *received;
  int64_t send_size, send_from, send_to;
  int64_t receive_size, used, filled;
  int64_t frame, row, rows_left; /* of the frame that is being read: its number in `incoming`, and the next row */
  int64_t heard_ns;
  _Atomic int64_t flushed_ns;
  int64_t about, about_row; /* why `state` is not OPEN: the link or kind, and the row or number */
  int64_t has_ended, is_known; /* what `streams_serve` has told Python */
  _Atomic int64_t state, sending;
} Stream;

typedef struct { /* all streams of a process */
  Place place;
  Stream *streams;
  int64_t n_streams;
  void *polled, *wishes; /* room for a pollfd for each stream and one more; for a wish for each of `told` */
  int64_t bell_pipe;     /* the end that is read */
  int64_t lazy_ns;       /* how long rows may wait that are lazy */
  _Atomic int64_t attention;
} Streams;

/* ---- a node */

typedef struct { /* members that step together, tick by tick: a tick of a single member is its own step */
  Member *members;
  int64_t n_members;
  int64_t tick_points, last_tick, tick;
  int64_t next; /* the member that steps next within the tick */
  int64_t burst; /* how many ticks it may take in one turn: about a slice of time */
  int64_t stopped, spent_ns;
  Counter *blocked_by; /* whom it waits for, and the value that it needs */
  int64_t need;
} Unit;

typedef struct { /* a process that may be some points behind, and no more */
  Counter *progress;
  int64_t window;
} Peer;

typedef struct { /* all units of a process */
  Place place;
  Streams *streams; /* NULL: all others share its memory, or send frames */
  Unit *units;
  int64_t n_units;
  Peer *peers;
  int64_t n_peers;
  Counter *ceiling;  /* the grant of the master */
  Counter *finish;   /* above 0: the run is over; NULL: that comes another way */
  Counter *progress; /* of this node */
  int64_t last_point, slice_ns;
  int64_t wait_ns;   /* how long to sleep where nothing can step */
  int64_t eager;     /* whether to leave, not to sleep, after a step: its rows have to be sent */
  int64_t quiet_ns;  /* for how long it goes on, waits included, because nobody looks at each step; 0: for a slice */
  int64_t spins;     /* whether it spins before it sleeps */
  int64_t batch;     /* how many points it may sleep for; 1 if others may wait for its next row */
  int64_t stride;    /* how many it sleeps for now */
  int64_t allowed, patience, waited_ns;
  int64_t restored;  /* how often a model had changed the floating-point mode */
  int64_t late;      /* sleeps that ended by their time limit although the value was there: lost wake-ups */
  int64_t unit, member; /* whom the result is about */
  _Atomic int64_t attention; /* Python has something to do */
} Node;

typedef struct { /* one of many copies of a system in this process */
  Node *node;
  int64_t point, goal; /* the last point that all its units have reached, and where it shall go */
  int64_t end;         /* a BurstEnd */
} Copy;

typedef struct { /* a getter or setter of one copy, for some variables */
  void *function, *component;
  const void *references;
  int64_t count, size; /* as those of Call; with the count -1, the function sets the state `references` */
} CopyCall;

typedef struct { /* an output of one copy: where it is in the first row of its ring, whose rows are so many points apart */
  const char *first; /* NULL: the copy could not begin */
  int64_t stride, mask, points;
} CopyOutput;

typedef struct { /* memory that each copy has: its place among what was kept, in numbers of eight bytes */
  int64_t kept, size;
} Keep;

enum WorkKind { STEP, CALL, READ, RESTORE, HAND_OVER }; /* Work.kind */

typedef struct { /* what is done with many copies: `wanted` says with which (NULL: all), and then which ones need Python */
  int64_t kind;
  Copy *copies;
  const CopyCall *calls; /* one for each copy; RESTORE: one for each of its FMUs */
  const CopyOutput *reads;
  const Keep *pieces;     /* RESTORE: the same of all copies */
  const void *places;     /* pointers: for each copy what was kept of it (NULL: nothing), and then where its pieces are */
  int64_t calls_each, pieces_each; /* of one copy */
  uint8_t *wanted;
  char *values;
  int64_t stride, size; /* from one copy to the next, and of one value; HAND_OVER: `size` is the number of a thread */
} Work;

typedef struct { /* a thread of copies: it calls the FMUs of those from `first` to `end`, and nobody else does */
  Place place;
  Counter *asked, *done; /* works that the first thread has begun, and that this one has done */
  Work *work;
  int64_t first, end;
  int64_t left; /* how many copies of the last one need Python */
} Worker;

enum BurstEnd { SLICE, DONE, ATTENTION, BLOCKED, PYTHON, STATUS, FORGED, NOT_FINITE, RAISED }; /* why node_run returns */

#endif
