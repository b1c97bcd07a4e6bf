// MuJoCo in WebAssembly: one model and its state.

/** @typedef {import("@mujoco/mujoco").MainModule} MuJoCo */

/** Arrays in WebAssembly's memory. @param {any} data @returns {Record<string, Float64Array>} */
function views({ qpos, qvel, ctrl, sensordata, xpos, xquat }) {
  return { qpos, qvel, ctrl, sensordata, xpos, xquat };
}

/** A scene of a robot's data, simulated. */
export class Physics {
  /**
   * @param {MuJoCo} mujoco
   * @param {any} data of the robot
   * @param {string} key of the scene
   */
  constructor(mujoco, data, key) {
    const scene = data.scenes[key];
    const base = scene.xml ? scene : data.scenes[""]; // soft servos are other numbers only
    this.mujoco = mujoco;
    this.scene = scene;
    this.model = mujoco.MjModel.from_xml_string(base.xml.replace("<asset>\n", `<asset>\n${data.meshes}`));
    this.data = new mujoco.MjData(this.model);
    this.scratch = new mujoco.MjData(this.model);
    this.setFields(base.fields);
    this.setFields(scene.fields);
    /** Numbers of the nominal model, of fields that scenarios change. @type {Map<string, Float64Array>} */
    this.nominal = new Map();
    this.views = views(this.data);
    this.reset();
  }

  /** The state, as arrays to read and write. */
  get state() {
    if (this.views.qpos.length === 0) {
      this.views = views(this.data); // WebAssembly's memory has grown, and moved
    }
    return this.views;
  }

  /** Puts the robot into the stance, or elsewhere; the model is the nominal one. @param {number[]} qpos */
  reset(qpos = this.scene.qpos) {
    for (const [name, values] of this.nominal) {
      this.field(name).set(values);
    }
    this.mujoco.mj_resetData(this.model, this.data);
    this.state.qpos.set(qpos);
    this.data.qacc_warmstart.set(this.scene.qacc_warmstart);
  }

  /** Gives the model a scenario's numbers: payload, friction, gains. @param {Record<string, [number[], number[]]>} fields */
  randomize(fields) {
    for (const name of Object.keys(fields)) {
      if (!this.nominal.has(name)) {
        this.nominal.set(name, this.field(name).slice());
      }
      this.field(name).set(/** @type {Float64Array} */ (this.nominal.get(name)));
    }
    this.setFields(fields);
    this.mujoco.mj_setConst(this.model, this.scratch);
  }

  /** @param {Record<string, [number[], number[]]>} fields */
  setFields(fields) {
    for (const [name, [indices, numbers]] of Object.entries(fields)) {
      const field = this.field(name);
      indices.forEach((place, k) => {
        field[place] = numbers[k];
      });
    }
  }

  /** @param {string} name @returns {Float64Array} */
  field(name) {
    return /** @type {any} */ (this.model)[name];
  }

  /** Adds to the trunk's velocity along the world's x and y, m/s. @param {number[]} velocity */
  push(velocity) {
    const { qvel } = this.state;
    this.scene.trunk_velocity.forEach((/** @type {number} */ place, /** @type {number} */ k) => {
      qvel[place] += velocity[k];
    });
  }

  /**
   * A physics step.
   * @param {ArrayLike<number>} joints targets of the leg servos, rad
   * @param {number[]} board targets of its servos, rad, and with a platform m
   */
  step(joints, board) {
    const { ctrl } = this.state;
    const { leg_ctrl, leg_trim, board_ctrl, platform_ctrl } = this.scene;
    for (let k = 0; k < leg_ctrl.length; k++) {
      ctrl[leg_ctrl[k]] = joints[k] + leg_trim[k];
    }
    [...board_ctrl, ...platform_ctrl].forEach((place, k) => {
      ctrl[place] = board[k] ?? 0;
    });
    this.mujoco.mj_step(this.model, this.data);
  }

  /** Gyro and accelerometer before the last step. @returns {number[]} */
  get imu() {
    const { sensordata } = this.state;
    return this.scene.sensors.map((/** @type {number} */ place) => sensordata[place]);
  }

  /** Joint angles of the legs, rad. @returns {number[]} */
  get joints() {
    const { qpos } = this.state;
    return this.scene.leg_qpos.map((/** @type {number} */ place) => qpos[place]);
  }

  /** Roll and pitch of the board, deg. @returns {number[]} */
  get board() {
    const { qpos } = this.state;
    return this.scene.board_qpos.map((/** @type {number} */ place) => (qpos[place] * 180) / Math.PI);
  }

  /** Angle between the body's z and the world's, deg; NaN if the simulation has diverged. */
  get tilt() {
    const { qpos } = this.state;
    const [, x, y] = this.scene.trunk_quat.map((/** @type {number} */ place) => qpos[place]);
    return ((2 * 180) / Math.PI) * Math.asin(Math.min(Math.hypot(x, y), 1));
  }

  /** Frees what WebAssembly holds. */
  delete() {
    this.data.delete();
    this.scratch.delete();
    this.model.delete();
  }
}
