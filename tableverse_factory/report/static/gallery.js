// Everything here is a convenience: without scripts the pages show the same scenes, page by page.
"use strict";
(() => {
  const root = document.body.dataset.root;
  const limit = 60;

  const button = document.querySelector(".theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const stored = () => { try { return localStorage.getItem("tableverse-theme"); } catch { return null; } };
  const isDark = () => (stored() || document.documentElement.dataset.theme || (system.matches ? "dark" : "light")) === "dark";
  const paint = (theme) => {
    if (theme) document.documentElement.dataset.theme = theme;
    button.textContent = isDark() ? "Light" : "Dark";
    button.setAttribute("aria-label", `Switch to ${isDark() ? "light" : "dark"} colours`);
  };
  button.hidden = false;
  paint(stored());
  button.addEventListener("click", () => {
    const theme = isDark() ? "light" : "dark";
    try { localStorage.setItem("tableverse-theme", theme); } catch { /* private windows keep nothing */ }
    paint(theme);
  });

  for (const copy of document.querySelectorAll(".copy")) {
    if (!navigator.clipboard) continue;
    copy.hidden = false;
    copy.addEventListener("click", async () => {
      await navigator.clipboard.writeText(copy.previousElementSibling.textContent);
      copy.textContent = "Copied";
      setTimeout(() => { copy.textContent = "Copy"; }, 1500);
    });
  }

  for (const slide of document.querySelectorAll(".slide")) {
    const compare = slide.parentElement;
    const range = slide.querySelector("input");
    slide.hidden = false;
    range.addEventListener("input", () => {
      compare.classList.add("over");
      compare.style.setProperty("--cut", `${100 - range.value}%`);
    });
  }

  for (const film of document.querySelectorAll(".film")) {
    const image = film.querySelector("img");
    const still = image.src;
    film.addEventListener("click", (event) => {
      if (event.ctrlKey || event.metaKey || event.shiftKey) return;
      event.preventDefault();
      image.src = film.classList.toggle("plays") ? film.href : still;
    });
  }

  const form = document.querySelector(".filter");
  if (!form) return;
  form.hidden = false;
  const list = document.getElementById("found");
  const shown = document.getElementById("shown");
  const status = form.querySelector(".found");
  let scenes = null;

  const load = () => new Promise((resolve) => {
    if (scenes) { resolve(); return; }
    const script = document.createElement("script");
    script.src = `${root}search.js`;
    script.onload = () => { scenes = window.TABLEVERSE; resolve(); };
    document.head.append(script);
  });
  const element = (tag, properties = {}, ...children) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  };
  const figure = (name, caption, title) => element("figure", {},
    element("img", { src: `${root}pictures/${name}-s.jpg`, alt: `${caption} of ${title}`, width: 320, height: 240, loading: "lazy" }),
    element("figcaption", { textContent: caption }));
  const card = (scene) => {
    const done = scene.status === "done";
    const href = done ? `${root}scenes/${scene.id}.html` : `${root}${scene.page}#${scene.id}`;
    const article = element("article", {}, element("h3", {}, element("a", { href, textContent: scene.title })));
    if (scene.picture) {
      article.append(element("div", { className: "pair" },
        figure(scene.picture, scene.picture.endsWith("-photo") ? "photograph" : "front", scene.title),
        figure(scene.twin, scene.twin.endsWith("-twin") ? "twin" : "top", scene.title)));
    }
    const first = done ? element("span", { className: "score", textContent: scene.score ? `${scene.score}/10` : "no score" })
      : element("span", { className: `flag is-${scene.status}`, textContent: scene.status });
    const meta = element("p", { className: "meta" }, first);
    if (scene.tried) meta.append(element("span", { textContent: `${scene.succeeded} of ${scene.tried} motions succeed` }));
    article.append(meta);
    article.append(element("p", { className: "names", textContent: done ? scene.text : scene.text.replaceAll("_", " ") }));
    return element("li", { className: "card" }, article);
  };
  const moves = {
    "": () => true,
    all: (scene) => scene.tried > 0 && scene.succeeded === scene.tried,
    some: (scene) => scene.succeeded > 0,
    fail: (scene) => scene.succeeded < scene.tried,
  };
  const matches = (scene, words, wanted, score, motions) =>
    (!wanted || scene.status === wanted) && (!score || (scene.score || 0) >= score) && moves[motions](scene) &&
    words.every((word) => `${scene.id} ${scene.title} ${scene.text} ${scene.text.replaceAll("_", " ")}`.toLowerCase().includes(word));

  const update = async () => {
    const data = new FormData(form);
    const words = data.get("q").toLowerCase().split(/\s+/).filter(Boolean);
    const wanted = data.get("status");
    const score = Number(data.get("score"));
    const motions = data.get("motions") || "";
    const active = words.length > 0 || wanted !== "" || score > 0 || motions !== "";
    if (!active) {
      list.hidden = true; shown.hidden = false; status.textContent = ""; list.replaceChildren();
      return;
    }
    await load();
    const found = scenes.filter((scene) => matches(scene, words, wanted, score, motions));
    list.replaceChildren(...found.slice(0, limit).map(card));
    list.hidden = false; shown.hidden = true;
    const count = found.length === 1 ? "1 scene" : `${found.length} scenes`;
    status.textContent = found.length > limit ? `${count}; the first ${limit} are shown` : found.length ? count : "No scene matches.";
  };
  let waiting = 0;
  form.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(update, 120); });
  form.addEventListener("submit", (event) => { event.preventDefault(); update(); });
})();
