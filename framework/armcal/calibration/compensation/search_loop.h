/* Searches for commands, LANES of them side by side; a lane whose search ends takes up the next target.

   The generated file defines evaluate(c, record, target, wish, free, damping, state; step, left, moved, error, pull),
   LANES, HOISTED and the sizes N_RECORD, N_TARGET, N_JOINTS, N_STATE and N_ERROR. Arrays are stored channel by channel:
   entry k of target i is at [k * count + i]. What each step does is told in array_search.py, which does the same. */
#define SIZE(n) ((n) > 0 ? (n) : 1)

typedef struct {
  long count;
  const double *record, *target, *state, *towards; /* towards may be null */
  const double *low, *high, *held;                 /* by joint */
  double *commands, *states, *distances, *turns, *there;
  double damping, patience, steps;
  double metres, radians, rest;
  double length, longest, first_damping, least_damping, wished_enough, wild;
} Search;

typedef struct {
  V record[N_RECORD], target[N_TARGET], wish[N_JOINTS], is_free[N_JOINTS], damping[1], state[SIZE(N_STATE)];
  V step[N_JOINTS], left[SIZE(N_STATE)], moved[SIZE(N_STATE)], error[N_ERROR], pull[N_JOINTS];
  V kept[N_JOINTS + N_STATE], away, turn;
  V best, milestone, waited, turns_taken;
  long at[LANES]; /* the target of each lane; -1 where there is none */
} Lanes;

static void begin(const Search *s, Lanes *now, int i, long at) {
  for (int k = 0; k < N_RECORD; ++k) now->record[k][i] = s->record[k * s->count + at];
  for (int k = 0; k < N_TARGET; ++k) now->target[k][i] = s->target[k * s->count + at];
  for (int k = 0; k < N_STATE; ++k) now->kept[N_JOINTS + k][i] = now->state[k][i] = s->state[k * s->count + at];
  for (int k = 0; k < N_JOINTS; ++k) {
    double q = now->record[k][i];
    now->kept[k][i] = now->record[k][i] = q < s->low[k] ? s->low[k] : q > s->high[k] ? s->high[k] : q;
    now->is_free[k][i] = s->held[k] ? 0 : 1;
    now->wish[k][i] = 0;
  }
  now->damping[0][i] = s->first_damping;
  now->best[i] = now->milestone[i] = now->away[i] = now->turn[i] = INFINITY;
  now->waited[i] = now->turns_taken[i] = 0;
}

/* What is wished beside the target; shortened as a whole, for joint by joint it would point elsewhere. */
static void set_wish(const Search *s, Lanes *now, int i) {
  double size = 0;
  for (int k = 0; k < N_JOINTS; ++k) {
    double wish = now->wish[k][i] = s->towards[k * s->count + now->at[i]] - now->record[k][i];
    if (fabs(wish) > size) size = fabs(wish);
  }
  if (size > s->longest)
    for (int k = 0; k < N_JOINTS; ++k) now->wish[k][i] *= s->longest / size;
}

static double norm_of(const V *vector, int from, int to, int i) {
  double sum = 0;
  for (int k = from; k < to; ++k) sum += vector[k][i] * vector[k][i];
  return sqrt(sum);
}

/* The largest size in a lane; not a number where any is none. */
static double largest(const V *vector, int count, int i) {
  double most = 0;
  for (int k = 0; k < count; ++k) {
    double size = fabs(vector[k][i]);
    if (!(size <= most)) most = size;
    if (isnan(size)) return size;
  }
  return most;
}

/* Keep what is there, else the best, and see whether it still becomes better; with a wish, how far that moves the arm
   counts. */
static void judge(const Search *s, Lanes *now, int i, double away, double turn, double size, int there) {
  double cost = away * away + s->length * turn * (s->length * turn);
  now->damping[0][i] = s->damping * (cost < 1 ? cost : 1) + s->least_damping;
  if (s->towards) cost += s->length * s->length * size * size;
  if (there || cost < now->best[i]) {
    for (int k = 0; k < N_JOINTS; ++k) now->kept[k][i] = now->record[k][i];
    for (int k = 0; k < N_STATE; ++k) now->kept[N_JOINTS + k][i] = now->state[k][i];
    now->best[i] = cost, now->away[i] = away, now->turn[i] = turn;
  }
  if (now->best[i] < 0.25 * now->milestone[i])
    now->milestone[i] = now->best[i], now->waited[i] = 0;
  else
    now->waited[i] += 1;
}

/* Whether a joint stands at a limit and is pulled away from it. */
static int pulled_back(const Search *s, const Lanes *now, int i, int k, double least) {
  double q = now->record[k][i], pull = now->pull[k][i];
  if (s->held[k] || now->is_free[k][i] != 0) return 0;
  return (q <= s->low[k] && pull > least) || (q >= s->high[k] && pull < -least);
}

static int is_there(const Search *s, const Lanes *now, int i, double away, double turn, double size) {
  if (!(away <= s->metres && turn <= s->radians && largest(now->left, N_STATE, i) <= s->rest)) return 0;
  if (!s->towards) return 1;
  if (!(size <= s->wished_enough)) return 0;
  for (int k = 0; k < N_JOINTS; ++k)
    if (pulled_back(s, now, i, k, s->wished_enough)) return 0;
  return 1;
}

static void move(const Search *s, Lanes *now, int i, double size) {
  double scale = size > s->longest ? s->longest / size : 1, along = scale;
  int finite = isfinite(size);
  for (int k = 0; k < N_JOINTS; ++k) {
    double q = now->record[k][i], wanted = finite ? q + scale * now->step[k][i] : q;
    double new = wanted < s->low[k] ? s->low[k] : wanted > s->high[k] ? s->high[k] : wanted;
    if (new != wanted) now->is_free[k][i] = along = 0;
    else if (pulled_back(s, now, i, k, 0)) now->is_free[k][i] = 1;
    now->record[k][i] = new;
  }
  for (int k = 0; k < N_STATE; ++k) {
    double ahead = now->state[k][i] + now->left[k][i] + along * now->moved[k][i];
    now->state[k][i] = finite && fabs(ahead) < s->wild ? ahead : 0;
  }
}

static void finish(const Search *s, const Lanes *now, int i, int there) {
  long at = now->at[i];
  for (int k = 0; k < N_JOINTS; ++k) s->commands[k * s->count + at] = now->kept[k][i];
  for (int k = 0; k < N_STATE; ++k) s->states[k * s->count + at] = now->kept[N_JOINTS + k][i];
  s->distances[at] = now->away[i], s->turns[at] = now->turn[i], s->there[at] = there;
}

/* What a step gave, for one lane; whether its search is at an end. */
static int advance(const Search *s, Lanes *now, int i) {
  double away = norm_of(now->error, 0, 3, i), turn = norm_of(now->error, 3, N_ERROR, i);
  double size = largest(now->step, N_JOINTS, i);
  int there = is_there(s, now, i, away, turn, size);
  judge(s, now, i, away, turn, size, there);
  now->turns_taken[i] += 1;
  if (there || now->waited[i] >= s->patience || now->turns_taken[i] >= s->steps) {
    finish(s, now, i, there);
    return 1;
  }
  move(s, now, i, size);
  return 0;
}

void armcal_search(const Search *s) {
  double c[HOISTED];
  Lanes now;
  long next = 0, busy = 0;
  if (!s->count) return;
  evaluate_hoist(c);
  for (int i = 0; i < LANES; ++i) {
    now.at[i] = next < s->count ? next++ : -1;
    begin(s, &now, i, now.at[i] < 0 ? 0 : now.at[i]);
    busy += now.at[i] >= 0;
  }
  while (busy) {
    for (int i = 0; i < LANES && s->towards; ++i)
      if (now.at[i] >= 0) set_wish(s, &now, i);
    evaluate(c, now.record, now.target, now.wish, now.is_free, now.damping, now.state, now.step, now.left, now.moved,
             now.error, now.pull);
    for (int i = 0; i < LANES; ++i) {
      if (now.at[i] < 0 || !advance(s, &now, i)) continue;
      now.at[i] = next < s->count ? next++ : -1;
      if (now.at[i] >= 0) begin(s, &now, i, now.at[i]);
      else --busy;
    }
  }
}
