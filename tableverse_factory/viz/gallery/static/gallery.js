// Optional: without scripts the pages show the same scenes, page by page.
"use strict";
(() => {
  const root = document.body.dataset.root;
  const pageSize = 24;

  const button = document.querySelector(".theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const stored = () => { try { return localStorage.getItem("tableverse-theme"); } catch { return null; } };
  const isDark = () => (stored() || document.documentElement.dataset.theme || (system.matches ? "dark" : "light")) === "dark";
  const paint = (theme) => {
    if (theme) document.documentElement.dataset.theme = theme;
    button.textContent = isDark() ? "Light" : "Dark";
    button.setAttribute("aria-label", `${button.textContent}: switch colours`);
  };
  button.hidden = false;
  paint(stored());
  button.addEventListener("click", () => {
    const theme = isDark() ? "light" : "dark";
    try { localStorage.setItem("tableverse-theme", theme); } catch { /* private windows store nothing */ }
    paint(theme);
  });

  for (const copy of document.querySelectorAll(".copy")) {
    if (!navigator.clipboard) continue;
    copy.hidden = false;
    copy.addEventListener("click", async () => {
      await navigator.clipboard.writeText(copy.previousElementSibling.textContent);
      copy.firstChild.textContent = "Copied";
      setTimeout(() => { copy.firstChild.textContent = "Copy"; }, 1500);
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
    film.setAttribute("role", "button");
    film.setAttribute("aria-pressed", "false");
    const toggle = () => {
      const plays = film.classList.toggle("plays");
      film.setAttribute("aria-pressed", String(plays));
      image.src = plays ? film.href : still;
    };
    film.addEventListener("click", (event) => {
      if (event.ctrlKey || event.metaKey || event.shiftKey) return;
      event.preventDefault();
      toggle();
    });
    film.addEventListener("keydown", (event) => { if (event.key === " ") { event.preventDefault(); toggle(); } });
  }

  const form = document.querySelector(".filter");
  if (!form) return;
  form.hidden = false;
  const more = form.querySelector("details");
  if (matchMedia("(max-width: 60rem)").matches) more.open = false;
  const found = document.getElementById("found");
  const list = found.querySelector("ul");
  const pager = found.querySelector("nav");
  const shown = document.getElementById("shown");
  const status = form.querySelector(".found");
  const small = document.querySelector("#cards").classList.contains("small");
  list.classList.toggle("small", small);

  // The order of the fields is that of viz/gallery/search_index.py.
  const doneScene = (labels) => ([id, title, score, usable, codes, depth, drift, names, objects, tasks, good, tried, pictures, scale]) => ({
    id, title: title || id, status: "done", score, usable: usable === 1, codes, depth, drift, objects, tasks, good, tried, pictures, scale,
    names: names.map((name) => labels[name]), href: `${root}scenes/${id}.html`,
  });
  const lostScene = ([id, title, state, why, page]) => ({
    id, title: title || id, status: state, codes: why ? [why] : [], names: [], pictures: [], score: null, depth: null, drift: null,
    objects: 0, tasks: 0, good: 0, tried: 0, href: `${root}${page}#${encodeURIComponent(id)}`,
  });
  const words = (text) => text.replaceAll("_", " ").toLowerCase();
  let loading = null;
  const load = () => loading ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = `${root}scenes.js`;
    const failed = () => { loading = null; script.remove(); reject(new Error("scenes.js does not load")); };
    script.onerror = failed;
    script.onload = () => {
      if (!window.TABLEVERSE) return failed();
      const data = window.TABLEVERSE;
      const scenes = [...data.done.map(doneScene(data.labels)), ...data.lost.map(lostScene)];
      for (const scene of scenes) {
        const codes = scene.codes.join(" ");
        scene.text = `${scene.id} ${scene.title} ${scene.names.join(" ")} ${codes} ${words(codes)} ${scene.status}`.toLowerCase();
        scene.labels = scene.names.map((name) => name.toLowerCase());
      }
      const options = data.labels.slice(0, data.offered).map((name) => element("option", { value: name }));
      document.getElementById("labels").replaceChildren(...options);
      resolve(scenes);
    };
    document.head.append(script);
  });

  const element = (tag, properties = {}, ...children) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  };
  const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
  const figure = (scene, kind) => element("figure", {},
    element("img", {
      src: `${root}pictures/${scene.id}-${kind === "photograph" ? "photo" : kind}-s.jpg`, loading: "lazy", width: 320, height: 240,
      alt: `${kind[0].toUpperCase()}${kind.slice(1)} of ${scene.title}`,
    }),
    element("figcaption", { textContent: kind }));
  const card = (scene) => {
    const article = element("article", {}, element("h3", {}, element("a", { href: scene.href, textContent: scene.title })));
    const pictures = small ? scene.pictures.slice(0, 1) : scene.pictures;
    if (pictures.length) {
      article.append(element("div", { className: pictures.length > 1 ? "shots two" : "shots" }, ...pictures.map((kind) => figure(scene, kind))));
    }
    const meta = element("p", { className: "meta" });
    if (scene.status === "done") {
      const points = scene.score === null ? ["no score"]
        : [element("strong", { textContent: scene.score }), element("span", { className: "of", textContent: "/10" })];
      meta.append(element("span", { className: `score${!scene.usable ? " poor" : scene.score >= 7 ? " good" : ""}` }, ...points),
        element("span", { textContent: counted(scene.objects, "object") }), element("span", { textContent: counted(scene.tasks, "task") }));
      if (scene.tried) meta.append(element("span", { textContent: `${scene.good} of ${scene.tried} motions succeed` }));
      if (!scene.usable) meta.append(element("span", { className: "flag", textContent: "not usable" }));
    } else {
      meta.append(element("span", { className: scene.status === "failed" ? "flag is-failed" : "flag is-dropped", textContent: scene.status }));
    }
    const told = scene.status === "done" ? [...scene.names.slice(0, 8), ...(scene.names.length > 8 ? ["…"] : [])].join(", ") : words(scene.codes.join(", "));
    article.append(meta, element("p", { className: "names", textContent: told }));
    return element("li", { className: "card" }, article);
  };

  const states = {
    usable: (scene) => scene.status === "done" && scene.usable,
    unusable: (scene) => scene.status === "done" && !scene.usable,
  };
  const moves = {
    all: (scene) => scene.tried > 0 && scene.good === scene.tried,
    some: (scene) => scene.good > 0,
    fail: (scene) => scene.good < scene.tried,
  };
  // A positive limit is a maximum (a minimum for scores); a negative one selects values beyond it.
  const within = (value, limit) => value !== null && (limit > 0 ? value <= limit : value > -limit);
  const tests = {
    q: (text) => { const each = text.toLowerCase().split(/\s+/).filter(Boolean); return (scene) => each.every((word) => scene.text.includes(word)); },
    label: (text) => { const name = text.toLowerCase().trim(); return (scene) => scene.labels.some((label) => label.includes(name)); },
    status: (value) => states[value] || ((scene) => scene.status === value),
    reason: (value) => (scene) => scene.codes.includes(value),
    score: (value) => (scene) => scene.score !== null && (value > 0 ? scene.score >= Number(value) : scene.score < -value),
    depth: (value) => (scene) => within(scene.depth, Number(value)),
    drift: (value) => (scene) => within(scene.drift, Number(value)),
    scale: (value) => (scene) => scene.scale === value,
    motions: (value) => moves[value] || (() => true),
  };
  const orders = new Set(["score", "depth", "drift"]);

  const fields = [...form.elements].filter((field) => field.name);
  let page = 1;
  const wanted = () => new URLSearchParams(fields.filter((field) => field.value.trim()).map((field) => [field.name, field.value.trim()]));
  const remember = (push) => {
    const state = wanted();
    if (page > 1) state.set("page", String(page));
    const hash = state.size ? `#${state}` : "#scenes";
    if (hash === location.hash || (!state.size && !location.hash.includes("="))) return;
    history[push ? "pushState" : "replaceState"](null, "", hash);
  };
  const recall = () => {
    const state = new URLSearchParams(location.hash.includes("=") ? location.hash.slice(1) : "");
    for (const field of fields) {
      const value = (state.get(field.name) || "").slice(0, 200);
      field.value = value;
      // Ignore values that are not among the options.
      if (field.value !== value) field.value = "";
    }
    page = Math.max(1, Math.floor(Number(state.get("page"))) || 1);
  };

  const complain = () => { status.textContent = "scenes.js does not load: filters do not work."; };
  let turn = 0;
  const update = async () => {
    const mine = ++turn;
    const state = wanted();
    if (!state.size) {
      found.hidden = true; shown.hidden = false; status.textContent = ""; list.replaceChildren();
      return;
    }
    let scenes;
    try { scenes = await load(); } catch { return complain(); }
    if (mine !== turn) return;
    const chosen = [...state].filter(([name]) => tests[name]).map(([name, value]) => tests[name](value));
    const hits = scenes.filter((scene) => chosen.every((test) => test(scene)));
    const order = state.get("sort");
    if (orders.has(order)) hits.sort((a, b) => (b[order] ?? -Infinity) - (a[order] ?? -Infinity));
    const pages = Math.max(1, Math.ceil(hits.length / pageSize));
    page = Math.min(page, pages);
    list.replaceChildren(...hits.slice((page - 1) * pageSize, page * pageSize).map(card));
    found.hidden = false; shown.hidden = true;
    pager.hidden = pages === 1;
    pager.querySelector(".place").textContent = `page ${page} of ${pages}`;
    pager.querySelector(".back").disabled = page === 1;
    pager.querySelector(".on").disabled = page === pages;
    status.textContent = hits.length ? `${hits.length} of ${counted(scenes.length, "scene")}${pages > 1 ? `, page ${page} of ${pages}` : ""}` : "No scene matches.";
  };
  const turned = (by) => async () => {
    page += by;
    remember(true);
    await update();
    form.scrollIntoView();
    list.querySelector("a")?.focus({ preventScroll: true });
  };
  pager.querySelector(".back").addEventListener("click", turned(-1));
  pager.querySelector(".on").addEventListener("click", turned(1));
  let waiting = 0;
  const changed = () => { page = 1; remember(false); update(); };
  form.addEventListener("focusin", () => { load().catch(complain); }, { once: true });
  form.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(changed, 120); });
  form.addEventListener("submit", (event) => { event.preventDefault(); clearTimeout(waiting); changed(); });
  form.addEventListener("reset", () => { clearTimeout(waiting); waiting = setTimeout(changed, 0); });
  addEventListener("hashchange", () => { recall(); update(); });
  addEventListener("popstate", () => { recall(); update(); });
  recall();
  if (wanted().size) update();
})();
