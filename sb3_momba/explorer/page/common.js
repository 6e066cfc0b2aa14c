"use strict";
// What the report and the live page share.
const explorer = (() => {
  // As charts.number writes them.
  function number(x) {
    for (const [size, unit] of [[1e12, ""], [1e9, " G"], [1e6, " M"]]) {
      if (Math.abs(x) >= size) return size === 1e12 ? x.toExponential(3) : `${Number((x / size).toPrecision(4))}${unit}`;
    }
    if (Math.abs(x) >= 1000) return Math.round(x).toLocaleString("en");
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

  // A return over a film, with a cursor; `height` gives the picture's y, from 0 to 32.
  function sparkline(returns, i, height, longest, colour) {
    const points = returns.map((r, k) => `${(100 * k) / longest},${height(r[i]).toFixed(2)}`).join(" ");
    const picture = svg("svg", { viewBox: "0 0 100 32", preserveAspectRatio: "none", "aria-hidden": "true" });
    picture.append(
      svg("line", { x1: 0, x2: 100, y1: height(0), y2: height(0), stroke: "#d9dee3", "vector-effect": "non-scaling-stroke" }),
      svg("polyline", { points, fill: "none", stroke: colour, "stroke-width": 1.5, "vector-effect": "non-scaling-stroke" }),
      svg("line", { id: `cursor-${i}`, y1: 0, y2: 32, stroke: "#1f2933", "vector-effect": "non-scaling-stroke" }),
    );
    picture.dataset.longest = longest;
    return picture;
  }

  // A return's height in a sparkline, 0 included.
  function scale(values) {
    const low = values.reduce((a, b) => Math.min(a, b), 0);
    const high = values.reduce((a, b) => Math.max(a, b), 0);
    return (x) => 30 - (28 * (x - low)) / (high > low ? high - low : 1);
  }

  // The numbers beside a film, in step with it.
  function showFrame(video, fps, returns) {
    const frame = Math.min(Math.floor(video.currentTime * fps + 1e-6), returns.length - 1);
    returns[frame].forEach((value, i) => {
      document.getElementById(`now-${i}`).textContent = number(value);
      const cursor = document.getElementById(`cursor-${i}`);
      const x = (100 * frame) / Number(cursor.parentNode.dataset.longest);
      cursor.setAttribute("x1", x);
      cursor.setAttribute("x2", x);
    });
  }

  // Where a point of returns is drawn, as charts.coordinates has it.
  function coordinates(values, [low, high]) {
    if (values.length === 2 || values.length === 3) return Object.fromEntries(values.map((v, i) => ["xyz"[i], [[v]]]));
    const heights = values.map((v, i) => (high[i] > low[i] ? (v - low[i]) / (high[i] - low[i]) : 0.5));
    return { x: [values.map((_, i) => i)], y: [heights] };
  }

  return { coordinates, element, number, scale, showFrame, sparkline, urlOf };
})();
