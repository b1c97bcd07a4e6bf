// Runs samples through the page's runtime, without a browser: node replay.mjs POLICY < SAMPLES.
// A sample is float64: joints, gyro, accelerometer; its answer: state, action, command, targets.
// A sample that begins with NaN resets. Line 1 of stderr is the reason of the last hold.
import { readFileSync, writeFileSync } from "node:fs";
import { readPolicy } from "../../demo/src/policy.js";
import { BALANCING, Controller, HOLDING, STANDING } from "../../demo/src/runtime.js";

const read = (file) => {
  const bytes = readFileSync(file);
  return bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
};
const controller = new Controller(readPolicy(read(process.argv[2])));
const joints = controller.joints.length;
const samples = new Float64Array(read(0));
const size = joints + 6;
const answers = new Float64Array((samples.length / size) * (4 + joints));
for (let k = 0; k < samples.length / size; k++) {
  const sample = samples.subarray(k * size, (k + 1) * size);
  if (Number.isNaN(sample[0])) {
    controller.reset();
  } else {
    controller.step(sample.subarray(0, joints), sample.subarray(joints));
  }
  const state = [STANDING, BALANCING, HOLDING].indexOf(controller.state);
  const { action, command, targets, reason } = controller;
  answers.set([state, action ?? -1, ...(command ?? [NaN, NaN]), ...targets], k * (4 + joints));
  if (reason && k === samples.length / size - 1) {
    console.error(reason);
  }
}
writeFileSync(1, Buffer.from(answers.buffer));
