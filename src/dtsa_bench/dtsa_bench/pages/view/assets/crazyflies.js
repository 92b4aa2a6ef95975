"use strict";
/* Crazyflies as their bridge sees them, with or without a run. */
const SURE_MS = 3000;

export class Crazyflies {
  /* order(content): sends an order; null: nothing may be ordered. */
  constructor(order) {
    this.rows = el("tbody");
    this.answer = el("output", {class: "answer"});
    const titles = ["", "State", "Battery", "Link"].map(name => el("th", {}, name));
    this.node = el("section", {class: "vehicles"}, el("h2", {}, "Crazyflies"), el("table", {}, el("thead", {}, el("tr", {}, ...titles)), this.rows),
      ...(order ? [el("div", {class: "line"}, el("button", {type: "button", "data-order": "land", onclick: () => order({kind: "land"})}, "Land all"), this.stop(order)), this.answer] : []));
  }

  /* To stop all motors takes two clicks within three seconds. */
  stop(order) {
    const button = el("button", {type: "button", class: "danger", "data-order": "emergency", onclick: () => {
      if (button.dataset.sure) { order({kind: "emergency", value: "stop all motors"}); calm(); return; }
      button.dataset.sure = "1"; button.textContent = "Once more: all motors stop, all fall";
      setTimeout(calm, SURE_MS);
    }}, "");
    const calm = () => { delete button.dataset.sure; button.textContent = "Emergency stop …"; };
    calm();
    return button;
  }

  /* told: [name, state, battery (V), link quality (0 to 1), reason] of each; answer: what has come of the last order. */
  show(told, answer) {
    this.rows.replaceChildren(...told.map(([name, state, battery, link, reason]) => el("tr", {class: `is-${state.split(" ")[0]}`, title: reason},
      el("td", {}, name), el("td", {}, state, reason ? el("small", {}, reason) : null), el("td", {}, battery > 0 ? num(battery, 2, "V") : "–"), el("td", {}, percent(link, 0)))));
    this.answer.textContent = answer;
  }
}
