// Keeps the page for when there is no network: it takes what the network has, and else what it kept.
const KEPT = "mjx_balance";
const PAGE = ["./", "index.html", "style.css", "main.js", "mujoco.wasm", "licenses.txt", "data/index.json"];

self.addEventListener("install", (event) => event.waitUntil(keep()));
self.addEventListener("activate", (event) => event.waitUntil(self.clients.claim()));
self.addEventListener("fetch", (event) => {
  if (event.request.method === "GET" && new URL(event.request.url).origin === location.origin) {
    event.respondWith(answer(event.request));
  }
});

async function keep() {
  const cache = await caches.open(KEPT);
  await cache.addAll(PAGE);
  const index = await (await cache.match("data/index.json")).json();
  const files = [...index.policies.map((x) => x.file), ...Object.keys(index.robots)];
  await cache.addAll(files.map((x) => `data/${x}`));
  await self.skipWaiting();
}

async function answer(request) {
  const cache = await caches.open(KEPT);
  try {
    const response = await fetch(request);
    if (response.ok) {
      await cache.put(request, response.clone());
    }
    return response;
  } catch (error) {
    const kept = await cache.match(request, { ignoreSearch: true });
    if (kept) {
      return kept;
    }
    throw error;
  }
}
