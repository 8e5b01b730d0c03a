/* One step of a surrogate made of Gaussian processes, from the tables in tables.c.

C99, float64, without heap and recursion; nothing of the C library but math. It follows the Python functions of the same
names, which explain the tables: compiled/step.py, compiled/regions.py, gp/compiled.py and environment/compiled/ of
surrogym_server. A table is addressed by its place; an item that does not exist has the place -1. */

#include "step.h"

#include <math.h>

#include "tables.h"

#define TURN_HALF 3.14159265358979323846
#define TURN (2 * TURN_HALF)

/* Entries of the first table, a row of places, sizes and flags (compiled/layout.py). */
enum {
    OBSERVE, FEATURES, WIDTH, LED_WIDTH, AFTER_FEATURES, AFTER_WIDTH, OUTPUT_COLUMNS, PROCESSES, LEAD, LEADS, RULES,
    INVERSE, MOVES_OBSERVATION, READS_AFTER, DECLARED, CONDITIONS, JUMPS, ENDING, WARP, HAS_STAGE
};
enum { FIRST_STAGE, LED_STAGE, AFTER_STAGE, STAGES };

static const double *table(int place) { return numbers + places[place][0]; }
static int rows(int place) { return places[place][1]; }
static int columns(int place) { return places[place][2]; }
static int at(double entry) { return (int)entry; }
static double between(double value, double low, double high)
{
    return value < low ? low : value > high ? high : value;
}

static double wrapped(double angle) /* to [-pi, pi) */
{
    double turned = angle + TURN_HALF;
    if (!(turned >= 0.0 && turned < TURN)) {
        turned = fmod(turned, TURN);
        if (turned < 0.0) turned += TURN;
    }
    return turned - TURN_HALF;
}

/* environment/compiled/terms.py */

static void evaluate(int place, const double *q, double *values)
{
    const double *constant = table(place), *frequencies = table(place + 1);
    const double *coefficients = table(place + 2), *limits = table(place + 3);
    const int terms = columns(place), waves = rows(place + 1), width = columns(place + 2);
    double basis[MOST_WIDTH];
    for (int c = 0; c < COORDINATES; c++) basis[c] = q[c];
    for (int w = 0; w < waves; w++) {
        double phase = 0.0;
        for (int c = 0; c < COORDINATES; c++) phase += frequencies[w * COORDINATES + c] * q[c];
        basis[COORDINATES + w] = sin(phase);
        basis[COORDINATES + waves + w] = cos(phase);
    }
    for (int t = 0; t < terms; t++) {
        double value = constant[t];
        for (int i = 0; i < width; i++)
            if (coefficients[t * width + i] != 0.0) value += coefficients[t * width + i] * basis[i];
        values[t] = between(value, limits[t], limits[terms + t]);
    }
}

static void holding(int place, const double *q, int *holds) /* by group */
{
    const double *head = table(place), *inequalities = table(place + 1);
    double values[MOST_WIDTH];
    for (int g = 0; g < at(head[1]); g++) holds[g] = 1;
    if (!rows(place + 1)) return;
    evaluate(at(head[0]), q, values);
    for (int k = 0; k < rows(place + 1); k++) {
        const double *one = inequalities + 3 * k;
        if (!(one[0] * values[k] >= one[1])) holds[at(one[2])] = 0;
    }
}

/* environment/compiled/features.py */

enum { AFFINE, COS, SIN, TURNED_COS, TURNED_SIN, WRAPPED, EQUAL, OBSERVED, GROWN };

static double grown(double value, double rate)
{
    const double size = fabs(rate), along = fmax(rate < 0 ? -value : value, -EDGE);
    const double bent = expm1(size * fmin(along, EDGE)) / size + exp(size * EDGE) * fmax(along - EDGE, 0.0);
    return rate < 0 ? -bent : bent;
}

/* Features begin to end - 1 of coordinates, action and lead, raw (C + F + L). */
static void encode(int place, int observe, const double *raw, double *x, int begin, int end)
{
    const double *weights = table(place + 1);
    double shown[MOST_WIDTH];
    int observed = 0;
    for (int f = begin; f < end; f++) {
        const double *row = table(place) + 5 * f;
        const int code = at(row[0]), entry = at(row[1]);
        double phase = 0.0;
        switch (code) {
        case AFFINE: x[f] = (raw[entry] - row[2]) / row[3]; break;
        case GROWN: x[f] = grown((raw[entry] - row[2]) / row[3], row[4]); break;
        case COS: x[f] = cos(raw[entry]); break;
        case SIN: x[f] = sin(raw[entry]); break;
        case TURNED_COS:
        case TURNED_SIN:
            for (int c = 0; c < COORDINATES; c++) phase += weights[f * COORDINATES + c] * raw[c];
            x[f] = code == TURNED_COS ? cos(phase) : sin(phase);
            break;
        case WRAPPED: x[f] = wrapped(raw[entry]) * sqrt(3.0) / TURN_HALF; break;
        case EQUAL: x[f] = raw[entry] == row[2] ? 1.0 : 0.0; break;
        default:
            if (!observed) evaluate(observe, raw, shown);
            observed = 1;
            x[f] = (shown[entry] - row[2]) / row[3];
        }
    }
}

/* gp/compiled.py */

enum { HEAD, INPUTS, POINTS, WEIGHTS, POLYNOMIALS, FACTOR };
enum { SCALE, CENTRE, PRIOR, PARITY, SIGNAL, CONSTANT, POLYNOMIAL, COUNT };

/* Latent deviation at inputs own (d), whose covariances with the points are k (n). Replaces k by L^-1 k. */
static double process_deviation(int place, const double *own, double *k)
{
    const double *head = table(place), *factor = table(place + FACTOR), *rows_ = table(place + POLYNOMIALS);
    const int size = columns(place + INPUTS), count = at(head[COUNT]);
    double variance = 0.0, exponent = 0.0;
    if (head[PARITY] != 0.0) {
        for (int j = 0; j < size; j++) exponent += rows_[4 * size + j] * own[j] * own[j];
        variance = head[PARITY] * head[SIGNAL] * exp(exponent);
    }
    variance += head[PRIOR];
    for (int j = 0; j < size; j++) {
        const double square = own[j] * own[j];
        variance += square * (rows_[2 * size + j] + square * rows_[3 * size + j]);
    }
    for (int i = 0; i < count; i++) {
        const double *row = factor + (long)i * count;
        double rest = k[i];
        for (int j = 0; j < i; j++) rest -= row[j] * k[j];
        k[i] = rest / row[i];
        variance -= k[i] * k[i];
    }
    return head[SCALE] * sqrt(fmax(variance, 0.0));
}

/* Mean, and latent deviation, at features x, in the output's unit. */
static void predict(int place, const double *x, double *mean, double *deviation)
{
    const double *head = table(place), *inputs = table(place + INPUTS), *points = table(place + POINTS);
    const double *weights = table(place + WEIGHTS), *rows_ = table(place + POLYNOMIALS);
    const int size = columns(place + INPUTS), all = rows(place + POINTS), count = at(head[COUNT]);
    double own[MOST_WIDTH], k[MOST_POINTS];
    *mean = head[CENTRE];
    for (int j = 0; j < size; j++) {
        own[j] = x[at(inputs[j])];
        *mean += own[j] * (rows_[j] + own[j] * rows_[size + j]);
    }
    for (int i = 0; i < all; i++) {
        double exponent = 0.0;
        for (int j = 0; j < size; j++) {
            const double difference = own[j] * inputs[size + j] - points[i * size + j];
            exponent -= 0.5 * difference * difference;
        }
        const double smooth = exp(exponent);
        *mean += weights[i] * smooth;
        if (i < count) k[i] = head[SIGNAL] * smooth;
        else k[i - count] += head[PARITY] * head[SIGNAL] * smooth; /* its mirror image */
    }
    if (head[POLYNOMIAL] != 0.0)
        for (int i = 0; i < count; i++) {
            const double *linear = rows_ + (5 + i) * size, *square = rows_ + (5 + count + i) * size;
            k[i] += head[CONSTANT];
            for (int j = 0; j < size; j++) k[i] += own[j] * (linear[j] + own[j] * square[j]);
        }
    *deviation = process_deviation(place, own, k);
}

/* environment/compiled/rules.py: limits, walls and angles, then lags */

enum { REACH_LOW, REACH_HIGH, LOW, HIGH, STOPS, ANGLE, LAG, SOURCE, RULE };
enum { CHANGE, TURNED, REPEAT, STEPS };

static double clipped(const double *rules, int c, double value)
{
    return between(value, rules[RULE * c + REACH_LOW], rules[RULE * c + REACH_HIGH]);
}

static void settle(const double *rules, double *q)
{
    for (int c = 0; c < COORDINATES; c++) q[c] = clipped(rules, c, q[c]);
    for (int c = 0; c < COORDINATES; c++) {
        const double *rule = rules + RULE * c;
        const int stopped = at(rule[STOPS]);
        if (stopped >= 0 && ((q[c] <= rule[LOW] && q[stopped] < 0) || (q[c] >= rule[HIGH] && q[stopped] > 0)))
            q[stopped] = 0.0;
        if (rule[ANGLE] != 0.0) q[c] = wrapped(q[c]);
    }
}

static void repeat(const double *rules, const double *raw, double *q)
{
    for (int c = 0; c < COORDINATES; c++) {
        const int lag = at(rules[RULE * c + LAG]), source = at(rules[RULE * c + SOURCE]);
        if (lag < 0) continue;
        double value = raw[source];
        if (lag == STEPS) value += 1.0;
        else if (lag != REPEAT) value = q[source] - value;
        q[c] = clipped(rules, c, lag == TURNED ? wrapped(value) : value);
    }
}

/* environment/compiled/reward.py */

enum { ONE, LINEAR, ABSOLUTE, SQUARE, BUMP, BALL };

static double declared(int place, const double *q, const double *u)
{
    const double *head = table(place), *weights = table(place + 1), *term = table(place + 2);
    const int quantities = columns(at(head[0]));
    double x[MOST_WIDTH], total = 0.0;
    int holds[MOST_WIDTH], i = 0;
    evaluate(at(head[0]), q, x);
    for (int f = 0; f < rows(place + 1); f++)
        for (int k = 0; k < quantities; k++) x[k] += weights[f * quantities + k] * u[f];
    holding(at(head[1]), q, holds);
    for (int t = 0; t < rows(place + 2); t++, term += 3) {
        const int shape = at(term[1]), end = i + at(term[2]);
        double shaped = shape == ONE ? 1.0 : 0.0;
        for (; i < end; i++)
            shaped += shape == LINEAR ? x[i] : shape == ABSOLUTE ? fabs(x[i]) : shape == ONE ? 0.0 : x[i] * x[i];
        if (shape == BUMP) shaped = exp(-0.5 * shaped);
        if (shape == BALL) shaped = shaped <= 1.0 ? 1.0 : 0.0;
        if (holds[t]) total += term[0] * shaped;
    }
    return total;
}

/* compiled/regions.py */

static double within(const double *form, const double *q)
{
    const double *cut = table(at(form[3])), *membership = table(at(form[3]) + 1);
    const int cuts = rows(at(form[3])), rules = columns(at(form[3]) + 1), terms = columns(at(form[2]));
    double values[MOST_WIDTH], outside = 1.0;
    evaluate(at(form[2]), q, values);
    for (int r = 0; r < rules; r++) {
        double rule = 0.0;
        for (int k = 0; k < cuts; k++) {
            const double weight = membership[k * rules + r], value = values[at(cut[3 * k]) % terms];
            const int side = at(cut[3 * k]) / terms;
            const double v = side == 0 ? value : side == 1 ? -value : fabs(value);
            if (weight != 0.0) rule += weight * between((v - cut[3 * k + 1]) / cut[3 * k + 2], 0.0, 1.0);
        }
        outside *= between(1.0 - rule, 0.0, 1.0);
    }
    return form[4] != 0.0 ? outside : 1.0 - outside;
}

static double classified(const double *form, int observe, const double *q)
{
    const int process = at(form[3]);
    double raw[COORDINATES + ACTIONS] = {0.0}, x[MOST_WIDTH], mean, deviation = 0.0;
    for (int c = 0; c < COORDINATES; c++) raw[c] = q[c];
    encode(at(form[2]), observe, raw, x, 0, at(form[4]));
    if (process >= 0) predict(process, x, &mean, &deviation);
    else mean = table(-process - 1)[0];
    return 0.5 * erfc(-(mean / fmax(deviation, 1e-9)) / sqrt(2.0));
}

static double probability(int place, int observe, const double *q)
{
    double total = 0.0;
    for (int f = 0; f < rows(place); f++) {
        const double *form = table(place) + columns(place) * f;
        total += form[0] * (form[1] != 0.0 ? classified(form, observe, q) : within(form, q));
    }
    return fmin(total, 1.0);
}

static void judge(const double *head, const double *q, const double *q_next, double *reward, double *deviation,
                  int *terminated)
{
    const double *state = head[READS_AFTER] != 0.0 ? q_next : q;
    const int jumps = at(head[JUMPS]), observe = at(head[OBSERVE]);
    double variance = *deviation * *deviation;
    if (jumps < 0) return; /* nothing is learned of this kind */
    for (int j = 0; j < rows(jumps); j++) {
        const double size = table(jumps)[2 * j], inside = probability(at(table(jumps)[2 * j + 1]), observe, state);
        variance += size * size * inside * (1.0 - inside);
        if (inside > 0.5) {
            *reward += size;
            break; /* the first of several that overlap counts */
        }
    }
    *deviation = sqrt(variance);
    if (at(head[ENDING]) >= 0) *terminated = probability(at(head[ENDING]), observe, q_next) > 0.5;
}

/* compiled/step.py */

static void encode_stage(const double *head, int stage, double *raw, const double *arrived, const double *mean,
                         double *x)
{
    int begin = stage == LED_STAGE ? at(head[WIDTH]) : 0;
    const int end = at(head[stage == FIRST_STAGE ? WIDTH : stage == LED_STAGE ? LED_WIDTH : AFTER_WIDTH]);
    if (stage == LED_STAGE)
        for (int i = 0; i < at(head[LEADS]); i++) {
            const int c = at(table(at(head[LEAD]))[i]);
            raw[COORDINATES + ACTIONS + i] = clipped(table(at(head[RULES])), c, raw[c] + mean[c]);
        }
    if (stage == AFTER_STAGE)
        for (int c = 0; c < COORDINATES; c++) raw[c] = arrived[c];
    encode(at(head[stage == AFTER_STAGE ? AFTER_FEATURES : FEATURES]), at(head[OBSERVE]), raw, x, begin, end);
}

static void predict_stage(const double *head, int stage, const double *x, double *mean, double *deviation)
{
    const int outputs = at(head[OUTPUT_COLUMNS]), processes = at(head[PROCESSES]);
    for (int o = 0; o < rows(outputs); o++)
        if (at(table(outputs)[3 * o + 2]) == stage) mean[o] = table(outputs)[3 * o];
    for (int p = 0; p < rows(processes); p++) {
        const double *one = table(processes) + 6 * p;
        const int column = at(one[1]), number = at(one[2]), rates = at(one[5]);
        if (at(one[0]) != stage) continue;
        predict(at(one[3]), x, mean + column, deviation + number);
        if (rates < 0) continue;
        double amplitude = 1.0; /* grows along the inputs */
        const double centre = table(rates + 1)[0], *grows = table(rates);
        for (int j = 0; j < columns(rates); j++) amplitude *= 1.0 + grows[columns(rates) + j] * x[at(grows[j])];
        mean[column] = centre + amplitude * (mean[column] - centre);
        deviation[number] *= amplitude;
    }
}

static void arrive(const double *head, const double *raw, const double *mean, double *arrived)
{
    const double *rules = table(at(head[RULES])), *sources = table(at(head[INVERSE]));
    for (int c = 0; c < COORDINATES; c++) arrived[c] = raw[c];
    if (head[MOVES_OBSERVATION] != 0.0) {
        double o[MOST_WIDTH];
        evaluate(at(head[OBSERVE]), arrived, o);
        for (int d = 0; d < OBSERVATIONS; d++) o[d] += mean[d];
        for (int s = 0; s < rows(at(head[INVERSE])); s++, sources += 3)
            arrived[at(sources[0])] =
                sources[2] < 0 ? o[at(sources[1])] : atan2(o[at(sources[2])], o[at(sources[1])]);
    } else {
        for (int c = 0; c < COORDINATES; c++) arrived[c] += mean[c];
    }
    settle(rules, arrived);
    repeat(rules, raw, arrived);
}

static void unwarp(const double *warp, double *mean, double *deviation)
{
    const double y = *mean, s = *deviation;
    *deviation = 0.5 * (exp(fmin(y + s, LARGEST)) - exp(fmin(y - s, LARGEST)));
    *mean = warp[0] + warp[1] * exp(fmin(y, LARGEST));
}

void surrogym_step(const double *q, const double *u, double *q_next, double *reward, double *deviation,
                   int *terminated)
{
    const double *head = table(0);
    double raw[COORDINATES + ACTIONS + COORDINATES], mean[MOST_WIDTH] = {0.0}, x[MOST_WIDTH];
    double *pay = mean + rows(at(head[OUTPUT_COLUMNS])) - 1, *doubt = deviation + OUTPUTS - 1;
    int holds[MOST_WIDTH];
    for (int c = 0; c < COORDINATES; c++) raw[c] = q[c];
    for (int f = 0; f < ACTIONS; f++) raw[COORDINATES + f] = u[f];
    for (int o = 0; o < OUTPUTS; o++) deviation[o] = 0.0;
    for (int stage = 0; stage < STAGES; stage++) {
        if (stage == AFTER_STAGE) arrive(head, raw, mean, q_next);
        if (head[HAS_STAGE + stage] == 0.0) continue;
        encode_stage(head, stage, raw, q_next, mean, x);
        predict_stage(head, stage, x, mean, deviation);
    }
    if (at(head[WARP]) >= 0) unwarp(table(at(head[WARP])), pay, doubt);
    if (at(head[DECLARED]) >= 0) *pay += declared(at(head[DECLARED]), head[READS_AFTER] != 0.0 ? q_next : q, u);
    *terminated = 0;
    if (at(head[CONDITIONS]) >= 0) {
        holding(at(head[CONDITIONS]), q_next, holds);
        for (int g = 0; g < at(table(at(head[CONDITIONS]))[1]); g++) *terminated |= holds[g];
    }
    *reward = *pay;
    judge(head, q, q_next, reward, doubt, terminated);
}

void surrogym_observe(const double *q, double *o) { evaluate(at(table(0)[OBSERVE]), q, o); }
