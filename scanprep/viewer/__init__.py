"""Bodies in a browser: a local server, the page that talks to it, and the messages between them.

    server      one server per command: its address, its end, what its page asks for, and the messages for it
    gate        who may ask; refusals in one line;  served_page  the page, and the headers that protect it
    messages    one message as bytes, as `source/connection.js` reads and writes them
"""
