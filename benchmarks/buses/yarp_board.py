"""A genuine rpc port of YARP: python yarp_board.py PORT_OF_THE_NAME_SERVER NAME.

For the Python that has YARP's bindings, with nothing else. A command is printed as a line; the line that
comes back is the answer.
"""

import os
import sys


def main() -> None:
    import yarp

    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # where YARP logs
    yarp.Network.init()
    yarp.Network.setNameServerContact(yarp.Contact("/root", "tcp", "127.0.0.1", int(sys.argv[1])))
    port, command, answer = yarp.RpcServer(), yarp.Bottle(), yarp.Bottle()
    if not port.open(sys.argv[2]):
        raise SystemExit(f"{sys.argv[2]} cannot be opened")
    print("ready", file=lines)
    while port.read(command, True):
        print(command.toString(), file=lines)
        line = sys.stdin.readline()
        if not line:
            return
        answer.fromString(line.strip())
        port.reply(answer)


if __name__ == "__main__":
    main()
