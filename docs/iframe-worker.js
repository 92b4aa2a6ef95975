/* Search on pages that are opened from the disk, where browsers refuse workers: a hidden frame does the worker's work. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.waiting = []; // messages for a frame that has not loaded its script yet
      const frame = document.body.appendChild(document.createElement("iframe"));
      frame.hidden = true;
      this.inside = frame.contentWindow;
      this.inside.document.open();
      this.inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", {data}));
      this.inside.begin = () => {
        this.waiting.forEach(data => this.deliver(data));
        this.waiting = null;
      };
      this.inside.document.write(`<script src="${url}"></script><script>begin()</script>`);
      this.inside.document.close();
    }

    deliver(data) {
      this.inside.dispatchEvent(new MessageEvent("message", {data}));
    }

    postMessage(data) {
      if (this.waiting) this.waiting.push(data);
      else this.deliver(data);
    }
  };
}
