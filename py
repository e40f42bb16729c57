nameserver 10.255.255.53
