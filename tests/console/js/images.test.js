// Places from which the page shows its images, and their colours at a switch.

import assert from "node:assert/strict";
import { test } from "node:test";
import "./page.js";

const { Images } = await import("../../../instant_ic/console/static/images.js");
const { identity, rotationZ } = await import("../../../instant_ic/console/static/math.js");
const { DEFAULT_PAGE } = await import("../../../instant_ic/console/static/messages.js");
const { fitGains, plain, Releasing } = await import("../../../instant_ic/console/static/colour.js");

function close(found, expected, tolerance) {
  found.forEach((value, i) => assert.ok(Math.abs(value - expected[i]) <= tolerance, `${found} instead of ${expected}`));
}

/** Scenes every 10 ms; `at` gives the camera's image, if a new one comes, and the state of a time in ms. */
function scenes(slow, duration, at) {
  let now = 0;
  const images = new Images({ slow, sample() {} }, { serverNow: () => now, clock: { roundTripMs: 10 }, acknowledge() {} });
  images.layers = { version: 1, mount: [0.1, 0, 1.2] };
  images.configure({ ...DEFAULT_PAGE, colour_release_s: 0 });
  const found = [];
  for (; now < duration; now += 10) {
    const { panorama, state } = at(now);
    images.panorama = panorama || images.panorama;
    const { glide, place, blend, panoramaFromLook } = images.scene({ at_ms: now, twist: [0.3, 0], ...state }, { yaw: 0, pitch: 0 }, [1, 0.6], 10);
    found.push({ glide: glide && glide.to[0], place: place[0], blend, panoramaFromLook });
  }
  return found;
}

// The robot drives at 0.3 m/s. Images come each 0.2 s, 0.1 s old; from 1 s on it is in ENTERING, from 2 s on in VIRTUAL,
// where the v-bot starts 3 cm back: where the shown image was taken. From 3 s on no image comes.
test("the shown place goes steadily, also through a switch, and an old image stays", () => {
  const x = (ms) => 0.0003 * ms;
  const frames = scenes(false, 5000, (now) => {
    const comes = now % 200 === 0 && now < 3000;
    const mode = now < 1000 ? "real" : now < 2000 ? "entering" : "virtual", shown = now < 2000 ? "real" : "virtual";
    return {
      panorama: comes && { q: [0, 0, 0, 1], p: [0.1 + x(now - 100), 0, 1.2], captured_ms: now - 100 },
      state: { mode, shown, robot: [x(now), 0, 0], vbot: [x(now) - 0.03, 0, 0] },
    };
  });
  for (let i = 40; i < 200; i++) close([frames[i].glide], [0.1 + 0.003 * i], 0.001); // no steps of 6 cm
  const mixed = frames.filter(({ blend }) => blend > 0 && blend < 1);
  assert.ok(mixed.length > 10);
  for (const { glide, place } of mixed) close([glide], [place], 1e-9); // both from one place
  for (let i = 191; i < 260; i++) {
    const step = frames[i].place - frames[i - 1].place;
    assert.ok(step > 0.001 && step < 0.0035, `${step}`); // the 3 cm go within 0.4 s
  }
  close([frames[260].place], [0.1 + 0.003 * 260 - 0.03], 0.002);
  assert.ok(frames.slice(410).every(({ glide }) => glide === null)); // the last image is more than 1 s old
});

// The robots are 7 cm apart at the switch back, as the camera's image is older than the pose, and drive at 0.3 m/s.
test("on the way back the view goes on from where the v-bot was", () => {
  const frames = scenes(true, 2000, (now) => {
    const [mode, shown] = now >= 1500 ? ["real", "real"] : ["returning", "virtual"];
    return {
      panorama: { q: [0, 0, 0, 1], captured_ms: now },
      state: { mode, shown, robot: [0.0003 * now + 0.07, 0, 0], vbot: [0.0003 * now, 0, 0] },
    };
  });
  for (let i = 101; i < 200; i++) close([frames[i].place - frames[i - 1].place], [0.003], 0.0035);
  close([frames[170].place], [0.1 + 0.0003 * 1700], 0.01); // if it stood still 0.55
  assert.equal(frames[140].blend, 1);
  assert.ok(frames[160].blend > 0 && frames[160].blend < 1);
  assert.equal(frames[190].blend, 0);
});

test("an old panorama is aimed anew when the robot turns", () => {
  const found = scenes(true, 500, (now) => {
    const robot = [0, 0, now < 100 ? 0 : 0.5];
    return { panorama: { q: [0, 0, 0, 1], captured_ms: 0 }, state: { mode: "real", shown: "real", robot, twist: [0, 0] } };
  });
  close(found[0].panoramaFromLook, identity, 1e-9);
  close(found.at(-1).panoramaFromLook, rotationZ(0.5), 1e-3);
});

test("a switch is a cut where the operator's system asks for little motion", () => {
  const images = new Images({ slow: true }, {});
  images.configure(DEFAULT_PAGE, true);
  assert.deepEqual([images.dissolveMs, images.motion.easeMs], [0, 0]);
});

test("gains are fitted in spite of what moved, and not at all without overlap", () => {
  const count = 400, gains = [0.8, 1, 1.25], part = (i, k) => ((i * k) % 101) / 101;
  const from = [], to = [];
  for (let i = 0; i < 3 * count; i++) {
    from.push(0.1 + 0.6 * part(i, 37));
    to.push(i < 240 ? part(i, 61) : from[i] * gains[i % 3]); // a fifth shows something else
  }
  close(fitGains(from, to, Array(count).fill(1)), gains, 0.04);
  assert.equal(fitGains(from, to, Array.from({ length: count }, (_, i) => +(i < 15))), plain);
});

test("matched gains fade out", () => {
  const gains = new Releasing();
  gains.releaseMs = 2000;
  gains.set([1.2, 1, 1], 100);
  close(gains.at(100), [1.2, 1, 1], 1e-9);
  close(gains.at(1100), [1.1, 1, 1], 1e-9); // half the time, half the gain
  assert.equal(gains.at(2100), plain);
});
