// Reads a policy file: safetensors with float32 weights, and a JSON manifest in the header.

/**
 * @typedef {{shape: number[], values: Float32Array}} Weight
 * @typedef {{manifest: any, weights: Map<string, Weight>}} Policy
 */

const FORMAT = "mjx_balance.policy";
const VERSION = 5;

/** What is wrong with a file, in a sentence. */
export class PolicyError extends Error {}

/**
 * Reads a policy file of format 5.
 * @param {ArrayBuffer} content
 * @returns {Policy}
 * @throws {PolicyError}
 */
export function readPolicy(content) {
  const size = content.byteLength < 8 ? NaN : Number(new DataView(content).getBigUint64(0, true));
  if (!(size <= content.byteLength - 8)) {
    throw new PolicyError("it is damaged or no safetensors file: it ends within its header");
  }
  const header = parse(new TextDecoder().decode(new Uint8Array(content, 8, size)), "its header");
  const manifest = parse(header.__metadata__?.manifest, "its manifest");
  delete header.__metadata__;
  if (manifest.format !== FORMAT || manifest.version !== VERSION) {
    throw new PolicyError(
      `it is ${manifest.format} version ${manifest.version}; this page runs ${FORMAT} version ${VERSION}`,
    );
  }
  const weights = new Map();
  for (const [name, entry] of Object.entries(header)) {
    weights.set(name, readWeight(content, 8 + size, name, entry));
  }
  return { manifest, weights };
}

/**
 * @param {ArrayBuffer} content
 * @param {number} start of the numbers
 * @param {string} name
 * @param {{dtype: string, shape: number[], data_offsets: [number, number]}} entry
 * @returns {Weight}
 */
function readWeight(content, start, name, entry) {
  const [begin, end] = entry.data_offsets;
  const count = entry.shape.reduce((a, b) => a * b, 1);
  if (entry.dtype !== "F32" || end - begin !== 4 * count || start + end > content.byteLength) {
    throw new PolicyError(`weight ${name} is not ${count} numbers of type F32`);
  }
  const values = new Float32Array(content.slice(start + begin, start + end));
  if (!values.every(Number.isFinite)) {
    throw new PolicyError(`weight ${name} holds values that are not finite numbers`);
  }
  return { shape: entry.shape, values };
}

/**
 * @param {any} text
 * @param {string} what
 */
function parse(text, what) {
  try {
    const value = JSON.parse(text);
    if (value instanceof Object) {
      return value;
    }
  } catch {
    // said below
  }
  throw new PolicyError(`it is no policy of mjx_balance: ${what} is not JSON`);
}
