"use strict";
// What the report and the live page share.
const explorer = (() => {
  const stillness = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  const config = { responsive: true, displaylogo: false, displayModeBar: false };
  const at = (id) => document.getElementById(id);

  // As charts.number writes them.
  function number(x) {
    for (const [size, unit] of [[1e12, ""], [1e9, " G"], [1e6, " M"]]) {
      if (Math.abs(x) >= size) return size === 1e12 ? x.toExponential(3) : `${Number((x / size).toPrecision(4))}${unit}`;
    }
    if (Math.abs(x) >= 1000) return x.toLocaleString("en", { maximumFractionDigits: 0 });
    return x === 0 || Math.abs(x) >= 1e-3 ? String(Number(x.toPrecision(4))) : x.toExponential(1);
  }

  function element(tag, text, attributes = {}) {
    const made = document.createElement(tag);
    if (text !== undefined) made.textContent = text;
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  }

  function svg(tag, attributes) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  }

  function urlOf(one) {
    if (!one.url) {
      const bytes = Uint8Array.from(atob(one.video), (character) => character.charCodeAt(0));
      one.url = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
    }
    return one.url;
  }

  // A row of an objective: its name, its return over the film with a cursor, so far, and in all. Without a film the name and
  // an empty cell. `films` share a scale.
  function returnRow(name, i, film, films, colour) {
    const row = element("tr");
    const cell = element("td", undefined, { class: "spark" });
    row.append(element("th", name, { scope: "row" }), cell);
    if (film !== null) {
      const every = films.flatMap((one) => one.returns.map((r) => r[i]));
      const [low, high] = [Math.min, Math.max].map((end) => every.reduce((a, b) => end(a, b), 0));
      const longest = Math.max(...films.map((one) => one.returns.length)) - 1 || 1;
      const height = (x) => 30 - (28 * (x - low)) / (high > low ? high - low : 1);
      const points = film.returns.map((r, k) => `${(100 * k) / longest},${height(r[i]).toFixed(2)}`).join(" ");
      const picture = svg("svg", { viewBox: "0 0 100 32", preserveAspectRatio: "none", "aria-hidden": "true" });
      picture.append(
        svg("line", { x1: 0, x2: 100, y1: height(0), y2: height(0), stroke: "#d9dee3", "vector-effect": "non-scaling-stroke" }),
        svg("polyline", { points, fill: "none", stroke: colour, "stroke-width": 1.5, "vector-effect": "non-scaling-stroke" }),
        svg("line", { id: `cursor-${i}`, y1: 0, y2: 32, stroke: "#1f2933", "vector-effect": "non-scaling-stroke" }),
      );
      picture.dataset.longest = longest;
      cell.append(picture);
      row.append(element("td", "0", { class: "now", id: `now-${i}` }), element("td", number(film.total[i])));
    }
    return row;
  }

  // The page's film, and the numbers beside it in step with it.
  class Player {
    film = null;
    #fps;
    #frame = 0; // of the one loop that runs while the film plays

    constructor(fps) {
      this.#fps = fps;
      at("film").addEventListener("play", () => this.#run());
      at("film").addEventListener("seeked", () => this.tick());
    }

    // `caption` and `preference` in words; a film of null shows nothing.
    show(film, caption, preference) {
      if (film !== this.film) {
        this.film = film;
        if (film === null) {
          at("film").removeAttribute("src");
        } else {
          at("film").src = urlOf(film);
          if (!stillness) at("film").play().catch(() => {}); // It may not be allowed to; there are controls.
        }
      }
      if (film === null) return;
      const speed = film.speed === null ? "" : `, ${Number(film.speed.toPrecision(2))}× real time`;
      at("film-caption").textContent = `${caption}. ${film.steps.toLocaleString("en")} steps${speed}.`;
      at("film").setAttribute("aria-label", `Rollout under the preference ${preference}`);
    }

    tick() {
      if (this.film === null) return;
      const { returns } = this.film;
      const frame = Math.min(Math.floor(at("film").currentTime * this.#fps + 1e-6), returns.length - 1);
      returns[frame].forEach((value, i) => {
        at(`now-${i}`).textContent = number(value);
        const cursor = at(`cursor-${i}`);
        const x = (100 * frame) / Number(cursor.closest("svg").dataset.longest);
        cursor.setAttribute("x1", x);
        cursor.setAttribute("x2", x);
      });
    }

    #run() {
      cancelAnimationFrame(this.#frame);
      this.tick();
      if (!at("film").paused) this.#frame = requestAnimationFrame(() => this.#run());
    }
  }

  // Where a point of returns is drawn, as charts.coordinates has it.
  function coordinates(values, [low, high]) {
    if (values.length === 2 || values.length === 3) return Object.fromEntries(values.map((v, i) => ["xyz"[i], [[v]]]));
    const heights = values.map((v, i) => (high[i] > low[i] ? (v - low[i]) / (high[i] - low[i]) : 0.5));
    return { x: [values.map((_, i) => i)], y: [heights] };
  }

  return { Player, at, config, coordinates, element, number, returnRow, stillness };
})();
