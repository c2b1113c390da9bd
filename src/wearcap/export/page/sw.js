// Keeps all files of the folder, so that the page works without a network once it was opened.

const KEPT = `wearcap-${self.location.search.slice(1)}`;

self.addEventListener("install", (event) => {
  event.waitUntil((async () => {
    const { files } = await (await fetch("files.json", { cache: "no-cache" })).json();
    const cache = await caches.open(KEPT);
    await cache.addAll(["./", "files.json", ...files].map((name) => new Request(name, { cache: "no-cache" })));
    await self.skipWaiting();
  })());
});

self.addEventListener("activate", (event) => {
  event.waitUntil((async () => {
    const names = await caches.keys();
    await Promise.all(names.filter((name) => name.startsWith("wearcap-") && name !== KEPT).map((name) => caches.delete(name)));
    await self.clients.claim();
  })());
});

self.addEventListener("fetch", (event) => {
  const { method, url } = event.request;
  if (method !== "GET" || new URL(url).origin !== self.location.origin) return;
  event.respondWith((async () => {
    const kept = await (await caches.open(KEPT)).match(event.request, { ignoreSearch: true });
    if (!kept) return fetch(event.request);
    // What the folder holds is looked up where it can be; everything else is of that version.
    return url.endsWith("/files.json") ? fetch(event.request).catch(() => kept) : kept;
  })());
});
