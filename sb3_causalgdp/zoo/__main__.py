from sb3_causalgdp.zoo.command_line import main

if __name__ == "__main__":
    main()
