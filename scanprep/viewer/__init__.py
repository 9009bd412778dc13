"""Bodies in a browser: the server of this machine that a page talks to, and what they say to each other.

    server      one server per command: its address, its thread, its end;  worker  one job after another, off the loop
    handlers    page, socket, uploads and downloads;  gate  who may ask for them, and what is refused in one line
    tabs        what each open tab is still to be told;  waiting  messages in order, the newest of its kind
    pages       an app inside of which others are opened, on the same server;  dropped  files kept while it runs
    messages    one message as bytes, as `source/connection.js` reads and writes them
"""
