/* Cart-pole with the equations of Gymnasium's CartPole-v1, in SI units.

   cc -O2 -ffp-contract=off -o cartpole cartpole.c -lm
   surrogym conformance --exec "./cartpole cartpole.json" */

#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GRAVITY 9.8
#define MASS_CART 1.0
#define MASS_POLE 0.1
#define LENGTH 0.5 /* half the pole's */
#define FORCE 10.0
#define TAU 0.02 /* s */
#define X_LIMIT 2.4
#define POLE_LIMIT (12 * 2 * 3.141592653589793 / 360)
#define START 0.05

static double state[4]; /* x, velocity, pole, omega */

/* The value of a field in a line of flat JSON, or NULL. */
static const char *field(const char *line, const char *name) {
  char key[32];
  snprintf(key, sizeof key, "\"%s\":", name);
  const char *found = strstr(line, key);
  return found == NULL ? NULL : found + strlen(key);
}

/* Read exactly `count` numbers from a JSON list; whether they are there. */
static int read_list(const char *text, double *numbers, int count) {
  if (text == NULL) return 0;
  while (*text == ' ') text++;
  if (*text++ != '[') return 0;
  for (int i = 0; i < count; i++) {
    char *end;
    numbers[i] = strtod(text, &end);
    if (end == text) return 0;
    while (*end == ' ') end++;
    if (*end != (i + 1 < count ? ',' : ']')) return 0;
    text = end + 1;
  }
  return 1;
}

/* A number in [0, 1), by splitmix64. */
static double uniform(uint64_t *seed) {
  uint64_t z = (*seed += 0x9e3779b97f4a7c15);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
  z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
  return (double)((z ^ (z >> 31)) >> 11) / 9007199254740992.0;
}

static void reset(const char *seed_text) {
  static uint64_t unseeded = 0;
  uint64_t seed = unseeded++;
  char *end = NULL;
  uint64_t given = seed_text == NULL ? 0 : strtoull(seed_text, &end, 10);
  if (end != seed_text) seed = given; /* it is not null */
  for (int i = 0; i < 4; i++) state[i] = START * (2 * uniform(&seed) - 1);
}

/* One step; whether the episode has ended. */
static int step(int action) {
  const double total = MASS_POLE + MASS_CART, pole_length = MASS_POLE * LENGTH;
  double x = state[0], velocity = state[1], pole = state[2], omega = state[3];
  double force = action == 1 ? FORCE : -FORCE, c = cos(pole), s = sin(pole);
  double temp = (force + pole_length * (omega * omega) * s) / total;
  double pole_acc = (GRAVITY * s - c * temp) / (LENGTH * (4.0 / 3.0 - MASS_POLE * (c * c) / total));
  double x_acc = temp - pole_length * pole_acc * c / total;
  state[0] = x + TAU * velocity;
  state[1] = velocity + TAU * x_acc;
  state[2] = pole + TAU * omega;
  state[3] = omega + TAU * pole_acc;
  return fabs(state[0]) > X_LIMIT || fabs(state[2]) > POLE_LIMIT;
}

/* 17 digits give every number back exactly. */
static void print_state(const char *further) {
  printf("\"result\": {\"state\": [%.17g, %.17g, %.17g, %.17g]%s}", state[0], state[1], state[2], state[3], further);
}

static void print_error(const char *message, const char *code) {
  printf("\"error\": \"%s\", \"code\": \"%s\"", message, code);
}

/* Print the result or the error of one request; whether it was close. */
static int answer(const char *line, const char *spec) {
  double numbers[4];
  const char *method = field(line, "method");
  char name[16] = "";
  if (method != NULL) sscanf(method, " \"%15[a-z]\"", name);
  if (strcmp(name, "spec") == 0) {
    printf("\"result\": {\"protocol\": 1, \"spec\": %s}", spec);
  } else if (strcmp(name, "reset") == 0 || strcmp(name, "get") == 0) {
    if (*name == 'r') reset(field(line, "seed"));
    print_state("");
  } else if (strcmp(name, "set") == 0) {
    if (!read_list(field(line, "state"), numbers, 4)) {
      print_error("expected four numbers for state", "invalid");
      return 0;
    }
    memcpy(state, numbers, sizeof state);
    print_state("");
  } else if (strcmp(name, "step") == 0) {
    if (!read_list(field(line, "action"), numbers, 1) || (numbers[0] != 0 && numbers[0] != 1)) {
      print_error("expected an action of 0 or 1", "invalid");
      return 0;
    }
    print_state(step((int)numbers[0]) ? ", \"reward\": 1, \"terminated\": true, \"truncated\": false"
                                      : ", \"reward\": 1, \"terminated\": false, \"truncated\": false");
  } else if (strcmp(name, "close") == 0) {
    printf("\"result\": {}");
    return 1;
  } else {
    print_error("expected spec, reset, set, get, step or close", *name ? "unsupported" : "invalid");
  }
  return 0;
}

/* The text of a file in one line. */
static char *read_file(const char *path) {
  char *text = calloc(1, 1 << 16);
  FILE *file = fopen(path, "r");
  if (text == NULL || file == NULL || fread(text, 1, (1 << 16) - 1, file) == 0) {
    perror(path);
    exit(2);
  }
  fclose(file);
  for (char *c = text; *c; c++)
    if (*c == '\n') *c = ' ';
  return text;
}

int main(int count, char **arguments) {
  if (count != 2) {
    fprintf(stderr, "expected cartpole SPECIFICATION.json\n");
    return 2;
  }
  char *spec = read_file(arguments[1]), *line = NULL;
  size_t size = 0;
  int closed = 0;
  while (!closed && getline(&line, &size, stdin) > 0) {
    const char *id = field(line, "id");
    if (id == NULL)
      printf("{\"id\": null, ");
    else
      printf("{\"id\": %lld, ", strtoll(id, NULL, 10));
    closed = answer(line, spec);
    printf("}\n");
    fflush(stdout);
  }
  return 0;
}
