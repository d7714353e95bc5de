from sonarrec.cli import main

main()
