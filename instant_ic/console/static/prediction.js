// @ts-check
// The v-bot's present pose, predicted from the last state message by the operator's later commands and the v-bot's kinematics.

/** @import { Vec3 } from "./math.js" */
/** @typedef {[number, number]} Twist m/s, rad/s */
import { clamp } from "./math.js";
import { advanced } from "./motion.js";

const MOST_MS = 250; // longest predicted time
const MOST_DELAY_MS = 100; // longest delay of a command for which the prediction allows
const STEP_MS = 10;
const SETTLED_MS = 700; // age of the last command after which the state's speed is kept

export class Prediction {
  constructor() {
    /** @type {[number, number]} Largest change of the speed, m/s² and rad/s². */
    this.maxAccel = [0, 0];
    /** @type {{at: number, twist: Twist}[]} Commands with the times of their first sending, oldest first. */
    this._commands = [];
  }

  /** Records a command of this page. @param {Twist} twist @param {number | null} now server's clock, ms */
  command(twist, now) {
    if (now === null) {
      this._commands = [];
      return;
    }
    const last = this._commands[this._commands.length - 1];
    if (last && last.twist[0] === twist[0] && last.twist[1] === twist[1]) return;
    this._commands.push({ at: now, twist: [...twist] });
    if (this._commands.length > 100) this._commands.shift();
  }

  /**
   * Returns pose and twist at the time `now`, predicted from those of a state at the time `at` (server's clock, ms).
   * @param {Vec3} pose @param {Twist} twist @param {number} at @param {number} now
   * @param {number} delayMs delay of a command; commands sent within this time before the state are not in it yet
   * @returns {{pose: Vec3, twist: Twist}}
   */
  from(pose, twist, at, now, delayMs) {
    const delay = clamp(delayMs, 0, MOST_DELAY_MS), start = at - delay;
    const end = Math.min(now, start + MOST_MS + delay);
    const newest = this._commands[this._commands.length - 1];
    const known = newest !== undefined && newest.at > start - SETTLED_MS;
    let t = start, speed = twist;
    while (t < end) {
      const step = Math.min(STEP_MS, end - t), seconds = step / 1000;
      const wanted = known ? this._at(t) : null;
      const [v, w] = speed;
      /** @type {Twist} */
      const next = wanted ? [toward(v, wanted[0], this.maxAccel[0] * seconds), toward(w, wanted[1], this.maxAccel[1] * seconds)] : speed;
      pose = advanced(pose, [(v + next[0]) / 2, (w + next[1]) / 2], seconds);
      speed = next;
      t += step;
    }
    return { pose, twist: end < now ? [0, 0] : speed }; // beyond MOST_MS the pose stands still
  }

  /** Returns the command at a time; null before the first one. @param {number} t @returns {Twist | null} */
  _at(t) {
    for (let i = this._commands.length - 1; i >= 0; i--) if (this._commands[i].at <= t) return this._commands[i].twist;
    return null;
  }
}

/** @param {number} value @param {number} target @param {number} step */
const toward = (value, target, step) => value + clamp(target - value, -step, step);
