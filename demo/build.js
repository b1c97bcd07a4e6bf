// Builds the page into a folder: node build.js [FOLDER]. Python adds `data/` (make demo).
import { build } from "esbuild";
import { cpSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const out = resolve(process.argv[2] ?? join(here, "..", "mjx_balance", "page"));
const packages = join(here, "node_modules");

rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
await build({
  entryPoints: [join(here, "src", "main.js")],
  outfile: join(out, "main.js"),
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "none", // licenses.txt has them
  external: ["module", "fs", "path", "url", "crypto"], // MuJoCo's under node
  logLevel: "warning",
});
for (const name of ["index.html", "style.css", "worker.js"]) {
  cpSync(join(here, "src", name), join(out, name));
}
cpSync(join(packages, "@mujoco", "mujoco", "mujoco.wasm"), join(out, "mujoco.wasm"));
const read = (...names) => readFileSync(join(...names), "utf8");
const version = (name) => JSON.parse(read(packages, name, "package.json")).version;
writeFileSync(
  join(out, "licenses.txt"),
  [
    `mjx_balance, and MuJoCo ${version("@mujoco/mujoco")} (Google DeepMind), under the Apache License 2.0:`,
    read(here, "..", "LICENSE"),
    `three.js ${version("three")}:`,
    read(packages, "three", "LICENSE"),
  ].join("\n\n"),
);
