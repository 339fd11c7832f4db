// When the legs of a plan are expected, and the marks of an axis of time.

import { clock, day } from "./format.js";

const STEPS_S = [300, 600, 900, 1800, 3600, 7200, 10_800, 21_600, 43_200, 86_400];
const NINE_IN_TEN = 1.645; // standard deviations on each side

// The points of the fan: now, the end of each leg, and the end of the shift. A plan does not say when legs begin, so the
// time that is left is spread evenly before them, as the forecast does.
export class LegSchedule {
  constructor(outlook, isRiding) {
    this.begins = [];
    this.charges = [];
    const now = outlook.time_s;
    const sd = NINE_IN_TEN * (outlook.soc_sd_pct ?? 0);
    this.points = outlook.soc_pct === null ? [] : [{ time: now, mean: outlook.soc_pct, low: outlook.soc_pct - sd, high: outlook.soc_pct + sd, words: "now" }];
    const { legs } = outlook;
    const driven = legs.reduce((sum, leg) => sum + leg.duration_s, 0);
    const waits = legs.length - (isRiding && legs.length ? 1 : 0) + 1;
    const wait = Math.max(0, (outlook.shift_end_s ?? now + driven) - now - driven) / waits;
    let time = now;
    legs.forEach((leg, i) => {
      time += i === 0 && isRiding ? 0 : wait;
      this.begins.push(time);
      const from = time;
      time += leg.duration_s;
      const isCharge = leg.charge_to_soc_pct !== undefined && leg.charge_to_soc_pct !== null;
      if (isCharge) this.charges.push({ from, to: time });
      if (isCharge && outlook.next_charge && this.charges.length === 1) this._add(from, outlook.next_charge.soc_pct, "before the charge");
      this._add(time, leg.soc_pct, `after leg ${i + 1}`);
    });
    if (outlook.shift_end_s) this._add(Math.max(outlook.shift_end_s, time + 1), outlook.soc_end_of_shift_pct, "end of the shift");
  }

  _add(time, soc, words) {
    if (soc) this.points.push({ time, mean: soc.mean, low: soc.p05, high: soc.p95, words });
  }
}

// Return marks of round times of day for an axis with room for so many.
export function makeClockMarks([low, high], room) {
  const step = STEPS_S.find((each) => (high - low) / each <= room) ?? STEPS_S.at(-1);
  const marks = [];
  for (let time = Math.ceil(low / step) * step; time <= high; time += step) {
    marks.push({ value: time, text: step < 86_400 ? clock(time) : day(time).slice(5) });
  }
  return marks;
}
