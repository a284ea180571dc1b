// Browsers start no workers for pages that were opened from a folder. The search's worker then runs in a frame of the page;
// the theme's worker asks for `IFrameWorker` to know that.
if (location.protocol === "file:") {
  window.Worker = window.IFrameWorker = class extends EventTarget {
    constructor(address) {
      super();
      this.waiting = [];
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.documentElement.append(frame);
      const inside = frame.contentWindow;
      const home = new URL(address, location.href);
      const load = (file) =>
        new Promise((done, fail) => {
          const script = inside.document.createElement("script");
          script.src = new URL(file, home);
          script.onload = done;
          script.onerror = fail;
          inside.document.documentElement.append(script);
        });
      inside.importScripts = (...files) => files.reduce((before, file) => before.then(() => load(file)), Promise.resolve());
      inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      this.give = (data) => inside.dispatchEvent(new MessageEvent("message", { data }));
      load(home).then(() => {
        this.waiting.forEach(this.give);
        this.waiting = null;
      });
    }
    postMessage(data) {
      this.waiting ? this.waiting.push(data) : this.give(data);
    }
    terminate() {}
  };
}
