"""Bodies in a browser: a local server, the page that talks to it, and the messages between them.

    server      one server per command: address, thread, end;  worker  runs one job after another, off the event loop
    handlers    page, socket, uploads and downloads;  gate  who may ask for them; refusals in one line
    tabs        messages that each open tab still has to get;  waiting  messages in order, the newest of its kind
    pages       an app that opens other apps on the same server;  dropped  files dropped on the page
    messages    one message as bytes, as `source/connection.js` reads and writes them
"""
