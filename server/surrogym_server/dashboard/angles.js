// Angles over the steps, without the jump from pi to -pi.

const TURN = 2 * Math.PI;

/** Counts full turns. */
function unwrapped(values) {
  let turns = 0;
  return values.map((value, at) => {
    if (at) turns -= Math.round((value - values[at - 1]) / TURN);
    return value + TURN * turns;
  });
}

/** Lines of one angle, nearest to each other at their starts (`meet` 0) or their ends (`meet` -1). */
export function unbroken(rows, meet) {
  const to = rows[0].at(meet);
  return rows.map((values) => {
    const line = unwrapped(values);
    const away = TURN * Math.round((line.at(meet) - to) / TURN);
    return line.map((value) => value - away);
  });
}
