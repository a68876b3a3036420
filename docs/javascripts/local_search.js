/* Browsers refuse workers to pages opened from a disk: there, an inner frame does the work of the search. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      this.waiting = [];
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      this.frame.srcdoc = "<!doctype html><title>search</title><body>";
      this.frame.onload = () => this.start(address);
      document.body.append(this.frame);
    }

    start(address) {
      this.frame.onload = null;
      this.inner = this.frame.contentWindow;
      this.inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = this.inner.document.createElement("script");
      script.src = address;
      script.onload = () => {
        this.started = true;
        this.waiting.splice(0).forEach((data) => this.deliver(data));
      };
      this.inner.document.body.append(script);
    }

    postMessage(data) {
      if (this.started) this.deliver(data);
      else this.waiting.push(data);
    }

    deliver(data) {
      this.inner.dispatchEvent(new this.inner.MessageEvent("message", { data }));
    }

    terminate() {
      this.frame.remove();
    }
  };
}
