// The page: loads robots and policies, runs them in real time, and listens to the reader.

import loadMuJoCo from "@mujoco/mujoco";
import { ImuPd, Stand } from "./baselines.js";
import { Physics } from "./physics.js";
import { Plot } from "./plots.js";
import { readPolicy } from "./policy.js";
import { clip, Controller, HOLDING } from "./runtime.js";
import { evaluate, Simulation } from "./simulation.js";
import { View } from "./view.js";

/** Choices beside policies: name -> what is shown, and how it is made. */
const BASELINES = {
  "pd-imu": { title: "pd-imu, a PD controller", make: (/** @type {any} */ data) => new ImuPd(data) },
  none: { title: "nobody: the legs stay still", make: (/** @type {any} */ data) => new Stand(data) },
};
const BY_HAND = "";
/** Suites: what happens in them. */
const SUITES = {
  [BY_HAND]: "You tilt the board: drag the disc, or use the arrow keys.",
  paper: "Every 10 s the board tilts in another direction, by up to 7°.",
  corner: "Both axes tilt by 7° at once.",
  noise: "As paper, with the sensor noise of a data sheet.",
  payload: "As paper, with up to 5 kg on the trunk.",
  friction: "As paper, on slippery or rough boards.",
  gains: "As paper, with servo gains off by up to 20%.",
  soft: "As paper, on soft servos.",
  latency: "As paper, but the legs obey one decision (0.2 s) late.",
  push: "As paper, with a push every 5 s.",
  fast: "As paper, with a faster board.",
  steep: "As paper, with a steeper board.",
  recover: "Board and body start tilted.",
  steps: "The board jumps.",
  sea: "The board rolls as on a swell.",
  platform: "The same, and it surges, sways and heaves.",
  bias: "As paper, with an IMU that is off by what makers allow.",
  encoder: "As paper, with joint encoders that are off.",
  delay: "As paper, with samples and commands that come late.",
  dropout: "As paper; every tenth IMU sample is lost.",
  shift: "As paper; a load is laid on in the middle.",
  slip: "As paper; a foot gets onto a slippery patch.",
  weak: "As paper; a servo weakens.",
};
const MOST_FRAME = 0.1; // s of simulation per frame: a slow device shows slow motion
const PLOT_EVERY = 0.04; // s between two samples of the plots
const SCENARIO_SECONDS = 60;
const KEY_STEP = 1; // deg that an arrow key tilts the board
const YIELD_EVERY = 30; // ms of evaluation between two looks at the page

/** What cannot be shown, in a sentence. */
class Problem extends Error {}

/** @template {HTMLElement} T @param {string} id @param {new () => T} kind @returns {T} */
function element(id, kind) {
  const found = document.getElementById(id);
  if (!(found instanceof kind)) {
    throw new Problem(`the page has no ${id}`);
  }
  return found;
}

/** @param {string} file */
async function load(file) {
  let response;
  try {
    response = await fetch(file);
  } catch {
    throw new Problem(`${file} cannot be loaded: there is no network, and the page has not been kept yet`);
  }
  if (!response.ok) {
    throw new Problem(`${file} cannot be loaded: ${response.status} ${response.statusText}`);
  }
  return response;
}

/** The page and its state. */
class Page {
  /**
   * @param {import("./physics.js").MuJoCo} mujoco
   * @param {any} index
   */
  constructor(mujoco, index) {
    this.mujoco = mujoco;
    this.index = index;
    /** Loaded data of robots, and policy files, by file name. @type {Map<string, Promise<any>>} */
    this.loaded = new Map();
    this.robot = element("robot", HTMLSelectElement);
    this.who = element("who", HTMLSelectElement);
    this.suite = element("suite", HTMLSelectElement);
    this.scenario = element("scenario", HTMLSelectElement);
    this.tiltText = element("tilt", HTMLElement);
    this.stateText = element("state", HTMLElement);
    this.speedText = element("speed", HTMLElement);
    this.pad = element("pad", HTMLElement);
    this.knob = element("knob", HTMLElement);
    this.tiltPlot = new Plot(element("tilt-plot", HTMLCanvasElement), ["--accent"], {
      signed: false,
      least: 1,
      limit: 6,
    });
    this.boardPlot = new Plot(element("board-plot", HTMLCanvasElement), ["--accent", "--second"], {
      signed: true,
      least: 8,
    });
    /** Where the disc is, right and away, deg. */
    this.pull = [0, 0];
    this.busy = false;
    /** File and key of the scene that is shown. */
    this.scene = "";
    this.due = 0;
    this.speed = 1;
    this.before = 0;
    try {
      this.view = new View(element("view", HTMLCanvasElement));
    } catch {
      complain("This browser cannot draw in 3-D (it has no WebGL); plots and numbers go on.");
    }
  }

  /** @param {string} file @param {"json" | "arrayBuffer"} kind */
  get(file, kind) {
    let promise = this.loaded.get(file);
    if (!promise) {
      promise = load(`data/${file}`).then((response) => response[kind]());
      promise.catch(() => this.loaded.delete(file));
      this.loaded.set(file, promise);
    }
    return promise;
  }

  /** Fills the choices from the address, and takes them. @param {URLSearchParams} query */
  async start(query) {
    const robots = [...new Set(Object.values(this.index.robots).map((x) => /** @type {any} */ (x).name))];
    const { policies } = this.index;
    const wanted = query.get("policy") ?? policies[0]?.name ?? "pd-imu";
    const policy = policies.find((/** @type {any} */ x) => x.name === wanted);
    if (!policy && !(wanted in BASELINES)) {
      const names = [...policies.map((/** @type {any} */ x) => x.name), ...Object.keys(BASELINES)];
      throw new Problem(`policy is '${wanted}'; this page has ${names.join(", ")}`);
    }
    fill(this.robot, robots.map((name) => [name, name.replaceAll("_", " ")]));
    const robot = policy ? this.index.robots[policy.robot].name : query.get("robot") ?? robots[0];
    this.robot.value = robot;
    if (this.robot.value !== robot) {
      throw new Problem(`robot is '${robot}'; this page has ${robots.join(", ")}`);
    }
    this.fillWho();
    this.who.value = wanted;
    const suite = query.get("run") ?? query.get("suite") ?? "paper";
    await this.choose(suite);
    if (query.has("run")) {
      await this.evaluate(number(query, "scenarios", 1, this.scenario.length), number(query, "duration", 0.2, 60));
    }
  }

  /** Offers the policies of the robot. */
  fillWho() {
    const policies = this.index.policies.filter(
      (/** @type {any} */ x) => this.index.robots[x.robot].name === this.robot.value,
    );
    fill(this.who, [
      ...policies.map((/** @type {any} */ x) => [x.name, `${x.name}, a policy`]),
      ...Object.entries(BASELINES).map(([name, { title }]) => [name, title]),
    ]);
  }

  /** Loads what is chosen, and starts it in a suite. @param {string} suite @param {number} scenario */
  async choose(suite = this.suite.value, scenario = 0) {
    this.busy = true;
    this.tell("loading");
    const who = this.who.value;
    const policy = this.index.policies.find((/** @type {any} */ x) => x.name === who);
    const file =
      policy?.robot ?? Object.keys(this.index.robots).find((x) => this.index.robots[x].name === this.robot.value);
    const [data, content] = await Promise.all([
      this.get(file, "json"),
      policy && this.get(policy.file, "arrayBuffer"),
    ]);
    if (suite !== BY_HAND && !(suite in data.suites)) {
      throw new Problem(`suite is '${suite}'; this robot has ${Object.keys(data.suites).join(", ")}`);
    }
    this.data = data;
    fill(this.suite, [
      [BY_HAND, "by hand"],
      ...Object.keys(data.suites).map((name) => [name, name]),
    ]);
    this.suite.value = suite;
    const scenarios = data.suites[suite]?.scenarios ?? [];
    fill(this.scenario, scenarios.map((/** @type {any} */ _, /** @type {number} */ k) => [String(k), String(k + 1)]));
    this.scenario.disabled = !scenarios.length;
    const key = data.suites[suite]?.scene ?? "";
    const scene = `${file} ${key}`;
    if (scene !== this.scene) {
      this.physics?.delete();
      this.physics = new Physics(this.mujoco, data, key);
      this.view?.show(this.physics);
      this.scene = scene;
    }
    const balancer = policy
      ? new Controller(readPolicy(content))
      : BASELINES[/** @type {keyof typeof BASELINES} */ (who)].make(data);
    this.simulation = new Simulation(/** @type {Physics} */ (this.physics), data, balancer);
    const about = this.index.robots[file];
    element("about", HTMLElement).textContent = SUITES[/** @type {keyof typeof SUITES} */ (suite)] ?? "";
    element("evaluate", HTMLButtonElement).disabled = suite === BY_HAND;
    element("source", HTMLElement).textContent = about.source
      ? `The model of ${about.name}, simplified for drawing, is from ${about.source}, under ${about.license}.`
      : "";
    this.restart(scenario);
    this.busy = false;
  }

  /** Starts a scenario of the suite, or the level board, anew. @param {number} scenario */
  restart(scenario = Number(this.scenario.value || 0)) {
    this.scenario.value = String(scenario);
    this.simulation?.reset(this.data.suites[this.suite.value]?.scenarios[scenario], scenario);
    this.tiltPlot.clear();
    this.boardPlot.clear();
    this.due = 0;
    this.speed = 1;
    this.before = performance.now(); // loading is no slow motion
    this.pull = [0, 0];
    this.showPull();
    element("off", HTMLButtonElement).setAttribute("aria-pressed", "false");
  }

  /** Tilts the board by hand, whatever moved it before. @param {number[]} pull right and away, deg */
  tiltBy(pull) {
    const { simulation } = this;
    if (!simulation || this.busy) {
      return;
    }
    if (this.suite.value !== BY_HAND) {
      simulation.takeOver();
      this.suite.value = BY_HAND;
      this.scenario.disabled = true;
      element("evaluate", HTMLButtonElement).disabled = true;
      element("about", HTMLElement).textContent = SUITES[BY_HAND];
    }
    const most = this.data.task.max_incline;
    const size = Math.hypot(pull[0], pull[1]);
    this.pull = pull.map((x) => (size > most ? (x / size) * most : x));
    this.aim();
    this.showPull();
  }

  /** The side that is pulled goes down, as the reader sees the board. */
  aim() {
    const { right, away } = this.view?.axes() ?? { right: [0, -1], away: [1, 0] };
    const [x, y] = [0, 1].map((k) => this.pull[0] * right[k] + this.pull[1] * away[k]);
    if (this.simulation) {
      this.simulation.aim = [-y, x];
    }
  }

  showPull() {
    const [x, y] = this.pull.map((value) => (40 * value) / (this.data?.task.max_incline ?? 1));
    this.knob.style.left = `${50 + x}%`;
    this.knob.style.top = `${50 - y}%`;
  }

  /** Pushes the robot in any direction. */
  push() {
    const speed = Number(element("push-size", HTMLInputElement).value) * this.data.task.push_scale;
    const angle = 2 * Math.PI * Math.random();
    this.physics?.push([speed * Math.cos(angle), speed * Math.sin(angle)]);
  }

  /** Switches the policy off; on again is a new start, because it must stand still then. */
  switchOff() {
    const button = element("off", HTMLButtonElement);
    const balancer = this.simulation?.balancer;
    if (button.getAttribute("aria-pressed") === "true") {
      this.restart();
    } else if (balancer) {
      balancer.hold("switched off");
      button.setAttribute("aria-pressed", "true");
    }
  }

  /** Runs what is due since the last frame, and draws. @param {number} now ms */
  frame(now) {
    const passed = Math.max((now - this.before) / 1000, 1e-3);
    this.before = now;
    const { simulation, physics, view } = this;
    if (simulation && physics && !this.busy) {
      const wanted = Math.min(passed, MOST_FRAME);
      this.speed += Math.min(passed, 1) * (wanted / passed - this.speed);
      for (this.due += wanted; this.due >= this.data.task.sim_dt; this.due -= this.data.task.sim_dt) {
        this.step(simulation, physics);
      }
      this.read(simulation);
      this.tiltPlot.draw();
      this.boardPlot.draw();
      view?.update(physics);
    }
    if (!this.busy) {
      view?.draw();
    }
    requestAnimationFrame((next) => this.frame(next));
  }

  /** @param {Simulation} simulation @param {Physics} physics */
  step(simulation, physics) {
    simulation.step();
    if (Math.round(simulation.time / this.data.task.sim_dt) % Math.round(PLOT_EVERY / this.data.task.sim_dt) === 0) {
      this.tiltPlot.add(simulation.time, [simulation.tilt]);
      this.boardPlot.add(simulation.time, physics.board);
    }
    if (this.suite.value !== BY_HAND && simulation.time >= SCENARIO_SECONDS) {
      this.restart((Number(this.scenario.value) + 1) % this.scenario.length);
    }
  }

  /** Shows tilt and state. @param {Simulation} simulation */
  read(simulation) {
    const { balancer, tilt, fellAt } = simulation;
    this.tiltText.textContent = Number.isFinite(tilt) ? `${tilt.toFixed(2)}°` : "–";
    const said = balancer.state === HOLDING ? `holding: ${balancer.reason}` : balancer.state;
    const fall = fellAt === null ? "" : `fell at ${fellAt.toFixed(1)} s (tilt above ${this.data.task.fail_tilt}°); `;
    this.tell(fall + said, fall !== "" || balancer.state === HOLDING);
    this.speedText.hidden = this.speed > 0.93;
    this.speedText.textContent = `slow motion: ${Math.round(100 * this.speed)}% of real time`;
  }

  /** @param {string} text @param {boolean} bad */
  tell(text, bad = false) {
    if (this.stateText.textContent !== text) {
      this.stateText.textContent = text;
      this.stateText.className = bad ? "bad" : "";
    }
  }

  /** Evaluates the suite as fast as it can. @param {number} count @param {number} duration s */
  async evaluate(count = this.scenario.length, duration = SCENARIO_SECONDS) {
    const { simulation } = this;
    const progress = element("progress", HTMLElement);
    const result = element("result", HTMLElement);
    if (!simulation || this.busy) {
      return;
    }
    this.busy = true;
    this.tell("evaluating");
    result.hidden = true;
    const channel = new MessageChannel();
    let looked = performance.now();
    const scenarios = this.data.suites[this.suite.value].scenarios.slice(0, count);
    const found = await evaluate(simulation, scenarios, duration, async (share) => {
      if (performance.now() - looked > YIELD_EVERY) {
        progress.textContent = `${Math.round(100 * share)}%`;
        await new Promise((resolve) => {
          channel.port1.onmessage = resolve;
          channel.port2.postMessage(null);
        });
        looked = performance.now();
      }
    });
    channel.port1.close();
    const about = { policy: this.who.value, robot: this.robot.value, suite: this.suite.value };
    result.textContent = JSON.stringify({ ...about, ...found }, null, 1);
    progress.textContent = `mean tilt ${found.tilt_deg.mean.toFixed(3)}°, greatest ${found.tilt_deg.max.toFixed(2)}°, falls: ${found.falls}`;
    result.hidden = false;
    this.busy = false;
    this.restart();
  }

  /** Connects the controls. */
  listen() {
    const guard = (/** @type {() => unknown} */ act) => async () => {
      try {
        await act();
      } catch (error) {
        report(error);
      }
    };
    this.robot.onchange = guard(() => (this.fillWho(), this.choose()));
    this.who.onchange = guard(() => this.choose(this.suite.value, Number(this.scenario.value || 0)));
    this.suite.onchange = guard(() => this.choose());
    this.scenario.onchange = () => this.restart();
    element("controls", HTMLFormElement).onsubmit = (event) => event.preventDefault();
    element("push", HTMLElement).onclick = () => this.push();
    element("off", HTMLElement).onclick = () => this.switchOff();
    element("again", HTMLElement).onclick = () => this.restart();
    element("evaluate", HTMLElement).onclick = guard(() => this.evaluate());
    const size = element("push-size", HTMLInputElement);
    size.oninput = () => {
      element("push-speed", HTMLOutputElement).value = Number(size.value).toFixed(1);
    };
    this.pad.onpointerdown = (event) => {
      this.pad.setPointerCapture(event.pointerId);
      this.drag(event);
    };
    this.pad.onpointermove = (event) => {
      if (this.pad.hasPointerCapture(event.pointerId)) {
        this.drag(event);
      }
    };
    addEventListener("keydown", (event) => this.press(event));
    this.view?.controls.addEventListener("change", () => {
      if (this.suite.value === BY_HAND) {
        this.aim();
      }
    });
    this.listenToPhone();
  }

  /** @param {PointerEvent} event */
  drag(event) {
    const box = this.pad.getBoundingClientRect();
    const most = this.data.task.max_incline / 0.4;
    this.tiltBy([
      ((event.clientX - box.left) / box.width - 0.5) * most,
      (0.5 - (event.clientY - box.top) / box.height) * most,
    ]);
  }

  /** @param {KeyboardEvent} event */
  press(event) {
    const busy = event.target instanceof HTMLSelectElement || event.target instanceof HTMLInputElement;
    if (busy || event.ctrlKey || event.metaKey || event.altKey || !this.simulation) {
      return;
    }
    const moves = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const move = moves[/** @type {keyof typeof moves} */ (event.key)];
    /** @type {Record<string, () => void>} */
    const keys = {
      p: () => this.push(),
      o: () => this.switchOff(),
      r: () => this.restart(),
      Home: () => this.tiltBy([0, 0]),
    };
    const act = move ? () => this.tiltBy(this.pull.map((x, k) => x + KEY_STEP * move[k])) : keys[event.key];
    if (act) {
      event.preventDefault();
      act();
    }
  }

  /** Offers to tilt the board as the phone is tilted, where there is a sensor. */
  listenToPhone() {
    const button = element("phone", HTMLButtonElement);
    button.hidden = !("DeviceOrientationEvent" in window) || !matchMedia("(pointer: coarse)").matches;
    /** @type {number[] | null} */
    let level = null;
    const follow = (/** @type {DeviceOrientationEvent} */ event) => {
      if (event.gamma !== null && event.beta !== null) {
        level ??= [event.gamma, event.beta];
        this.tiltBy([event.gamma - level[0], level[1] - event.beta]);
      }
    };
    button.onclick = async () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      const sensor = /** @type {any} */ (DeviceOrientationEvent);
      if (on && (await sensor.requestPermission?.().catch(() => "denied")) === "denied") {
        complain("The phone did not allow the page to read its orientation; the disc tilts the board.");
        return;
      }
      level = null;
      button.setAttribute("aria-pressed", String(on));
      (on ? addEventListener : removeEventListener)("deviceorientation", follow);
    };
  }
}

/** @param {HTMLSelectElement} select @param {string[][]} options values and texts */
function fill(select, options) {
  const old = select.value;
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  select.value = options.some(([value]) => value === old) ? old : options[0]?.[0] ?? "";
}

/**
 * A number of the address.
 * @param {URLSearchParams} query
 * @param {string} name
 * @param {number} least
 * @param {number} most which is also the default
 */
function number(query, name, least, most) {
  const value = Number(query.get(name) ?? most);
  if (!(least <= value && value <= most)) {
    throw new Problem(`${name} is '${query.get(name)}'; it must be a number from ${least} to ${most}`);
  }
  return value;
}

/** @param {string} sentence */
function complain(sentence) {
  const problem = element("problem", HTMLElement);
  problem.textContent = sentence;
  problem.hidden = false;
}

/** @param {unknown} error */
function report(error) {
  element("state", HTMLElement).textContent = "stopped";
  complain(error instanceof Error ? error.message : String(error));
}

async function main() {
  const query = new URLSearchParams(location.search);
  const [index, mujoco] = await Promise.all([
    load("data/index.json").then((response) => response.json()),
    loadMuJoCo({ locateFile: (/** @type {string} */ name) => name }),
  ]);
  const page = new Page(mujoco, index);
  page.listen();
  requestAnimationFrame((now) => page.frame(now));
  await page.start(query);
  if ("serviceWorker" in navigator && isSecureContext) {
    await navigator.serviceWorker.register("worker.js").catch(() => {}); // then not offline
  }
}

if (location.protocol !== "file:" && typeof WebAssembly === "object") {
  main().catch(report);
}
