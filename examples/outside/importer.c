/* A program that takes part in the mesh of outside.yaml: its output is its input, times two. */
#include <stdio.h>

#include "outside.h"

int main(int argc, char **argv) {
  char error[600];
  Outside *own = outside_attach(argc > 1 ? argv[1] : "outside/importer", 30000000000, error, sizeof error);
  if (own == NULL) {
    fprintf(stderr, "%s\n", error);
    return 1;
  }
  const int64_t angle = outside_index(own, "angle"), doubled = outside_index(own, "doubled");
  double value = 0.0;
  int result = outside_begin(own);
  while (result == OUTSIDE_OK) {
    outside_get_float64(own, angle, &value, 1);
    value *= 2.0;
    outside_set_float64(own, doubled, &value, 1);
    result = outside_step(own, 1);
  }
  printf("%s at %g s\n", outside_error(own), outside_time(own));
  outside_detach(own);
  return result != OUTSIDE_ENDED;
}
